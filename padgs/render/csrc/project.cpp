// Projection of all Gaussians, forward and backward: sixteen at a time, no shared state.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "bounds.h"
#include "kernels.h"
#include "low_pass.h"
#include "planar.h"
#include "projective.h"
#include "simd_math.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

constexpr int64_t kBlock = 1024;  // Gaussians per partial sum of the pose gradient; fixed, so that sums are too

float clamp(float x, float low, float high) { return std::min(std::max(x, low), high); }

// The pixels whose centres lie in a range; empty where none does.
PixelBox pixel_box(const Camera &camera, const PixelRange &range) {
  const int width = camera.width, height = camera.height;
  const int row = int(std::ceil(clamp(range.v0 - 0.5f, -1.0f, float(height))));
  const int row_end = int(std::floor(clamp(range.v1 - 0.5f, -1.0f, float(height)))) + 1;
  PixelBox box{0, 0, 0, std::max(row, 0), std::min(row_end, height)};
  if (box.row >= box.row_end) return {0, 0, 0, 0, 0};
  int column = int(std::ceil(clamp(range.u0 - 0.5f, -2.0f * width, 3.0f * width)));
  int column_end = int(std::floor(clamp(range.u1 - 0.5f, -2.0f * width, 3.0f * width))) + 1;
  if (!camera.wrap) {
    column = std::max(column, 0);
    column_end = std::min(column_end, width);
  } else if (column_end - column >= width) {
    column = 0;
    column_end = width;
  }
  if (column >= column_end) return {0, 0, 0, 0, 0};
  const int turns = column >= 0 ? column / width : -((-column + width - 1) / width);
  box.column = column - turns * width;
  box.column_end = std::min(column_end - turns * width, width);
  box.second_end = std::max(column_end - turns * width - width, 0);
  return box;
}

// The published bounds: a square of 3 sigma of the longest axis, rounded out to 16-pixel tiles and cut at the borders.
PixelBox square_box(const Camera &camera, float u, float v, float uu, float uv, float vv) {
  const float middle = 0.5f * (uu + vv);
  const float longest = middle + std::sqrt(std::max(0.1f, middle * middle - (uu * vv - uv * uv)));
  const float radius = std::ceil(3.0f * std::sqrt(longest));
  const auto edge = [&](float p, int pixels) { return int(clamp(kTile * std::floor(p / kTile), 0.0f, float(pixels))); };
  const PixelBox box{edge(u - 0.5f - radius, camera.width), edge(u - 0.5f + radius + kTile - 1, camera.width), 0,
                     edge(v - 0.5f - radius, camera.height), edge(v - 0.5f + radius + kTile - 1, camera.height)};
  return box.column < box.column_end && box.row < box.row_end ? box : PixelBox{0, 0, 0, 0, 0};
}

// Sixteen items of an array of N x width floats, one vector per component. Lanes past the end repeat the last item.
template <int kWidth>
void load_items(const float *array, int64_t first, int64_t count, Vec *out) {
  float lanes[kWidth][kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    const float *item = array + std::min(first + lane, count - 1) * kWidth;
    for (int k = 0; k < kWidth; ++k) lanes[k][lane] = item[k];
  }
  for (int k = 0; k < kWidth; ++k) out[k] = load(lanes[k]);
}

template <int kWidth>
void store_items(float *array, int64_t first, int64_t count, const Vec *in) {
  float lanes[kWidth][kLanes];
  for (int k = 0; k < kWidth; ++k) store(lanes[k], in[k]);
  const int end = int(std::min<int64_t>(kLanes, count - first));
  for (int lane = 0; lane < end; ++lane)
    for (int k = 0; k < kWidth; ++k) array[(first + lane) * kWidth + k] = lanes[k][lane];
}

// Sixteen Gaussians in the camera frame, with what their world-frame gradients need.
struct Batch {
  CameraGaussian<Vec> gaussian;
  Quaternion<Vec> unit;
  Vec norm;
  Vec3<Vec> mean;  // world
  Mat3<Vec> camera;

  Batch(const Camera &cam, const Inputs &in, int64_t first) {
    const float *p = cam.cam_from_world;
    const auto column = [&](int k) { return Vec3<Vec>{splat(p[k]), splat(p[4 + k]), splat(p[8 + k])}; };
    camera = {column(0), column(1), column(2)};
    Vec m[3], q[4], s[3], o[1];
    load_items<3>(in.means, first, in.count, m);
    load_items<4>(in.quats, first, in.count, q);
    load_items<3>(in.scales, first, in.count, s);
    load_items<1>(in.opacities, first, in.count, o);
    mean = {m[0], m[1], m[2]};
    unit = normalized(Quaternion<Vec>{q[0], q[1], q[2], q[3]}, norm);
    gaussian.orientation = times(camera, rotation(unit));
    gaussian.mean = times(camera, mean) + column(3);
    gaussian.scale = {s[0], s[1], s[2]};
    gaussian.opacity = o[0];
  }
};

// What one batch leaves: shapes and whatever the boxes need, lane by lane.
struct Projected {
  float shape[11][kLanes], opacity[kLanes], log2_opacity[kLanes], depth[kLanes], in_front[kLanes];
  float bounds[12][kLanes];  // planar: half_u, half_v, uu, uv, vv, det;  projective: mean (3), cone (9)
};

template <template <class> class Chart>
void project_planar(const Camera &camera, const Inputs &in, int64_t first, const CameraGaussian<Vec> &g, Projected &out) {
  const Chart<Vec> chart(camera, g.mean);
  const Covariance2D<Vec> s = project_covariance(g.spread(), chart.jacobian_u, chart.jacobian_v, camera.low_pass);
  Vec u = chart.u, v = chart.v;
  if (in.probe) {
    Vec probe[2];
    load_items<2>(in.probe, first, in.count, probe);
    u += probe[0] * (0.5f * float(camera.width));
    v += probe[1] * (0.5f * float(camera.height));
  }
  const Vec log2_opacity = logarithm2(larger(g.opacity, splat(1e-30f)));
  const PlanarShape<Vec> shape = planar_shape(s, log2_opacity);
  const Vec values[5] = {u, v, shape.a, shape.b, shape.c};
  for (int k = 0; k < 5; ++k) store(out.shape[k], values[k]);
  for (int k = 5; k < 11; ++k) store(out.shape[k], zero());
  store(out.opacity, g.opacity);
  store(out.log2_opacity, log2_opacity);
  store(out.depth, chart.depth);
  store(out.in_front, chart.in_front(camera.near_radius));
  const Vec bounds[6] = {shape.half_u, shape.half_v, s.uu, s.uv, s.vv, s.determinant};
  for (int k = 0; k < 6; ++k) store(out.bounds[k], bounds[k]);
}

// The probe of a projective footprint moves the mean itself, by the same share of the image on a panorama.
Vec3<Vec> probed_mean(const Inputs &in, int64_t first, Vec3<Vec> mean) {
  if (!in.probe) return mean;
  Vec probe[2];
  load_items<2>(in.probe, first, in.count, probe);
  const SphereFrame<Vec> f = sphere_frame(mean);
  return mean + scaled(probe[0] * kPi * f.r * f.cos_latitude, f.east) + scaled(probe[1] * (0.5f * kPi) * f.r, f.down);
}

void store_projective(const ProjectiveShape<Vec> &s, Vec opacity, Vec depth, const Mat3<Vec> &cone, Projected &out) {
  const Vec values[11] = {s.l0.x, s.l0.y, s.l0.z, s.l1.x, s.l1.y, s.l1.z, s.m.x, s.m.y, s.m.z, s.kappa, s.near_ratio};
  for (int k = 0; k < 11; ++k) store(out.shape[k], values[k]);
  const Vec3<Vec> columns[3] = {cone.c0, cone.c1, cone.c2};
  for (int k = 0; k < 3; ++k) {
    store(out.bounds[3 + 3 * k], columns[k].x);
    store(out.bounds[4 + 3 * k], columns[k].y);
    store(out.bounds[5 + 3 * k], columns[k].z);
  }
  store(out.opacity, opacity);
  store(out.log2_opacity, logarithm2(larger(opacity, splat(1e-30f))));
  store(out.depth, depth);
}

// 2 ln(255 o): the largest q that is drawn.
Vec largest_q(Vec opacity) {
  return maximum((logarithm2(larger(opacity, splat(1e-30f))) + 7.994353437f) * (1.0f / kHalfLog2E), zero()) * kSlack;
}

void project_tangent(const Camera &camera, const CameraGaussian<Vec> &g, Projected &out) {
  const TangentModel<Vec> model(g, camera.low_pass);
  store_projective(model.shape(), g.opacity, model.frame.r, model.cone(largest_q(g.opacity)), out);
  store(out.in_front, model.frame.r - camera.near_radius);
}

void project_ray(const Camera &camera, const CameraGaussian<Vec> &g, Projected &out) {
  const RayModel<Vec> model(g);
  const Vec k = largest_q(g.opacity);
  store_projective(model.shape(g, camera.near_radius), g.opacity, model.frame.r, model.cone(g, k), out);
  // Not drawn from inside: rho^2 <= 2 ln(255 o).
  const Vec exact = (logarithm2(larger(g.opacity, splat(1e-30f))) + 7.994353437f) * (1.0f / kHalfLog2E);
  Vec margin = minimum(model.frame.r - camera.near_radius, model.rho * model.rho - exact);
  if (camera.cull_ellipsoids) {
    const Vec3<Vec> along = transposed_times(g.spread(), model.frame.normal);
    const Vec reach = model.frame.r - root(maximum(exact, zero()) * dot(along, along));
    margin = minimum(margin, reach - camera.near_radius);
  }
  store(out.in_front, margin);
}

PixelBox box_of(const Camera &camera, const Projected &p, int lane) {
  const auto bound = [&](int k) { return p.bounds[k][lane]; };
  if (camera.projection == kErp || camera.projection == kPinhole) {
    const float u = p.shape[0][lane], v = p.shape[1][lane];
    if (camera.square) return square_box(camera, u, v, bound(2), bound(3), bound(4));
    const float half_u = bound(0) * kSlack + kSlackPixels, half_v = bound(1) * kSlack + kSlackPixels;
    return pixel_box(camera, {u - half_u, u + half_u, v - half_v, v + half_v});
  }
  if (camera.model == kTableModel) return {0, camera.width, 0, 0, camera.height};  // it may look anywhere
  const auto vector = [&](int k) { return Vec3<float>{bound(k), bound(k + 1), bound(k + 2)}; };
  const SphereFrame<float> frame = sphere_frame(vector(0));
  const Cone cone{{vector(3), vector(6), vector(9)}, frame.normal};
  if (camera.model == kPanoramaModel)
    return pixel_box(camera, sphere_range(cone, frame, float(camera.width), float(camera.height)));
  if (misses_pinhole(cone, camera)) return {0, 0, 0, 0, 0};
  return pixel_box(camera, pinhole_range(cone, camera));
}

// Whether nothing overflowed on the way to a footprint and its bounds.
bool finite(const Projected &p, bool planar, int lane) {
  float total = 0;
  for (int k = 0; k < 11; ++k) total += std::fabs(p.shape[k][lane]);
  for (int k = 0; k < (planar ? 6 : 12); ++k) total += std::fabs(p.bounds[k][lane]);
  return std::isfinite(total);
}

void forward_batch(const Camera &camera, const Inputs &in, int64_t first, Footprint *footprints, PixelBox *boxes) {
  Batch batch(camera, in, first);
  Projected p;
  const bool planar = camera.projection == kErp || camera.projection == kPinhole;
  if (!planar) batch.gaussian.mean = probed_mean(in, first, batch.gaussian.mean);
  const CameraGaussian<Vec> g = Widened<Vec>(camera, batch.gaussian).gaussian;
  if (planar) {
    camera.projection == kErp ? project_planar<ErpChart>(camera, in, first, g, p)
                              : project_planar<PinholeChart>(camera, in, first, g, p);
  } else {
    camera.projection == kTangent ? project_tangent(camera, g, p) : project_ray(camera, g, p);
    const Vec mean[3] = {batch.gaussian.mean.x, batch.gaussian.mean.y, batch.gaussian.mean.z};
    for (int k = 0; k < 3; ++k) store(p.bounds[k], mean[k]);
  }
  const int end = int(std::min<int64_t>(kLanes, in.count - first));
  for (int lane = 0; lane < end; ++lane) {
    Footprint &f = footprints[first + lane];
    PixelBox &box = boxes[first + lane];
    box = {0, 0, 0, 0, 0};
    const bool within_reach = p.depth[lane] >= kNearest && p.depth[lane] <= kFurthest;
    if (p.opacity[lane] >= kAlphaMin && p.in_front[lane] > 0 && within_reach && finite(p, planar, lane))
      box = box_of(camera, p, lane);
    for (int k = 0; k < 11; ++k) f.shape[k] = p.shape[k][lane];
    f.log2_opacity = p.log2_opacity[lane];
    f.depth = p.depth[lane];
    std::memcpy(&f.red, in.colors + 3 * (first + lane), 3 * sizeof(float));
  }
}

struct Backward {
  CameraGaussianGradient<Vec> gradient;
  Vec probe_u, probe_v;
};

template <template <class> class Chart>
Backward planar_backward(const Camera &camera, const CameraGaussian<Vec> &g, const Vec *m, Vec grad_depth) {
  const Chart<Vec> chart(camera, g.mean);
  const Covariance2D<Vec> s = project_covariance(g.spread(), chart.jacobian_u, chart.jacobian_v, camera.low_pass);
  PlanarGradient<Vec> f = planar_gradient(s, m);
  f.depth = grad_depth;
  Backward out{planar_vjp(g, chart, f), f.u * (0.5f * float(camera.width)), f.v * (0.5f * float(camera.height))};
  out.gradient.log_opacity = m[0];
  return out;
}

Backward projective_backward(const Camera &camera, const CameraGaussian<Vec> &g, const Vec *m, Vec grad_depth) {
  const ProjectiveMoments<Vec> moments = projective_moments(m);
  Backward out;
  out.gradient = camera.projection == kTangent ? TangentModel<Vec>(g, camera.low_pass).vjp(g, moments, grad_depth)
                                               : RayModel<Vec>(g).vjp(g, moments, grad_depth);
  const SphereFrame<Vec> f = sphere_frame(g.mean);  // the probe moves along it, which changes no radius: no widening
  out.probe_u = dot(out.gradient.mean, f.east) * f.r * f.cos_latitude * kPi;
  out.probe_v = dot(out.gradient.mean, f.down) * f.r * (0.5f * kPi);
  return out;
}

void add_pose(const Batch &batch, const CameraGaussianGradient<Vec> &g, double *pose) {
  // mean_cam = R mean + t and orientation = R R_q: dL/dR = grad_mean mean^T + grad_orientation R_q^T.
  const Mat3<Vec> local = rotation(batch.unit);
  const Vec3<Vec> a = g.mean, m = batch.mean;
  const Mat3<Vec> &o = g.orientation;
  const Vec rows[3][3] = {{a.x, o.c0.x, o.c1.x}, {a.y, o.c0.y, o.c1.y}, {a.z, o.c0.z, o.c1.z}};
  const Vec last[3] = {o.c2.x, o.c2.y, o.c2.z}, moved[3] = {a.x, a.y, a.z};
  for (int k = 0; k < 3; ++k) {
    const Vec *r = rows[k];
    pose[4 * k] += sum(r[0] * m.x + r[1] * local.c0.x + r[2] * local.c1.x + last[k] * local.c2.x);
    pose[4 * k + 1] += sum(r[0] * m.y + r[1] * local.c0.y + r[2] * local.c1.y + last[k] * local.c2.y);
    pose[4 * k + 2] += sum(r[0] * m.z + r[1] * local.c0.z + r[2] * local.c1.z + last[k] * local.c2.z);
    pose[4 * k + 3] += sum(moved[k]);
  }
}

// Gradients of sixteen Gaussians from their moments. Where all moments are 0, so are the gradients.
void backward_batch(const Camera &camera, const Inputs &in, const float *moments, int64_t first, const Gradients &out,
                    double *pose) {
  Batch batch(camera, in, first);
  Vec m[kMoments], active = zero();
  load_items<kMoments>(moments, first, in.count, m);
  for (int k = 0; k < kMoments; ++k) active += magnitude(m[k]);
  const int end = int(std::min<int64_t>(kLanes, in.count - first));
  const Vec on = select(less(zero(), active), select(less(iota(), splat(float(end))), splat(1.0f), zero()), zero());
  const Vec grad_depth = m[13];
  CameraGaussian<Vec> &g = batch.gaussian;
  if (camera.projection == kTangent || camera.projection == kRay) g.mean = probed_mean(in, first, g.mean);
  const Widened<Vec> wide(camera, g);
  Backward b = camera.projection == kErp       ? planar_backward<ErpChart>(camera, wide.gaussian, m, grad_depth)
               : camera.projection == kPinhole ? planar_backward<PinholeChart>(camera, wide.gaussian, m, grad_depth)
                                               : projective_backward(camera, wide.gaussian, m, grad_depth);
  wide.vjp(g, b.gradient);
  // Lanes that drew nothing may hold anything, infinities too; they are replaced, not multiplied.
  const auto clean = [&](Vec v) { return select(less(zero(), on), v, zero()); };
  const auto clean3 = [&](Vec3<Vec> v) { return Vec3<Vec>{clean(v.x), clean(v.y), clean(v.z)}; };
  b.gradient.mean = clean3(b.gradient.mean);
  b.gradient.scale = clean3(b.gradient.scale);
  b.gradient.orientation = {clean3(b.gradient.orientation.c0), clean3(b.gradient.orientation.c1),
                            clean3(b.gradient.orientation.c2)};
  const Vec3<Vec> mean = transposed_times(batch.camera, b.gradient.mean);
  const Mat3<Vec> &o = b.gradient.orientation;
  const Quaternion<Vec> q =
      rotation_vjp(batch.unit, batch.norm, Mat3<Vec>{transposed_times(batch.camera, o.c0), transposed_times(batch.camera, o.c1),
                                           transposed_times(batch.camera, o.c2)});
  const Vec means[3] = {mean.x, mean.y, mean.z}, quats[4] = {clean(q.w), clean(q.x), clean(q.y), clean(q.z)};
  const Vec scales[3] = {b.gradient.scale.x, b.gradient.scale.y, b.gradient.scale.z};
  const Vec opacities[1] = {clean(b.gradient.log_opacity / g.opacity)}, colors[3] = {m[10], m[11], m[12]};
  const Vec probe[2] = {clean(b.probe_u), clean(b.probe_v)};
  store_items<3>(out.means, first, in.count, means);
  store_items<4>(out.quats, first, in.count, quats);
  store_items<3>(out.scales, first, in.count, scales);
  store_items<1>(out.opacities, first, in.count, opacities);
  store_items<3>(out.colors, first, in.count, colors);
  if (out.probe) store_items<2>(out.probe, first, in.count, probe);
  if (pose) add_pose(batch, b.gradient, pose);
}

void forward(const Camera &camera, const Inputs &in, Footprint *footprints, PixelBox *boxes) {
#pragma omp parallel for schedule(static)
  for (int64_t first = 0; first < in.count; first += kLanes) forward_batch(camera, in, first, footprints, boxes);
}

void backward(const Camera &camera, const Inputs &in, const float *moments, const Gradients &out) {
  const int64_t blocks = (in.count + kBlock - 1) / kBlock;
  std::vector<double> poses(out.pose ? 12 * blocks : 0, 0.0);
#pragma omp parallel for schedule(static)
  for (int64_t block = 0; block < blocks; ++block) {
    double *pose = out.pose ? poses.data() + 12 * block : nullptr;
    for (int64_t first = block * kBlock; first < std::min(in.count, (block + 1) * kBlock); first += kLanes)
      backward_batch(camera, in, moments, first, out, pose);
  }
  if (!out.pose) return;
  std::fill_n(out.pose, 12, 0.0);
  for (int64_t block = 0; block < blocks; ++block)
    for (int k = 0; k < 12; ++k) out.pose[k] += poses[12 * block + k];
}

}  // namespace

extern const ProjectKernels project_kernels;
const ProjectKernels project_kernels = {forward, backward};

}  // namespace PADGS_ISA
}  // namespace padgs
