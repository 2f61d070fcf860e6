// One Gaussian on its way to the image and back, of any scalar type: into the camera frame, widened, projected to a
// footprint and its bounds; and from the gradient sums that blending leaves to the gradient of every input.
#pragma once

#include "boxes.h"
#include "low_pass.h"
#include "planar.h"
#include "projective.h"

namespace padgs {

PADGS_HD bool planar(int32_t projection) { return projection == kErp || projection == kPinhole; }

// A Gaussian in the camera frame, with the values that gradients in the world frame need.
template <class T>
struct PosedGaussian {
  CameraGaussian<T> gaussian;
  Quaternion<T> unit;
  T norm;
  Vec3<T> mean;  // world
  Mat3<T> camera;

  PADGS_HD PosedGaussian(const float *pose, Vec3<T> world, Quaternion<T> quat, Vec3<T> scale, T opacity) : mean(world) {
    camera = {column(pose, 0), column(pose, 1), column(pose, 2)};
    unit = normalized(quat, norm);
    gaussian.orientation = times(camera, rotation(unit));
    gaussian.mean = times(camera, mean) + column(pose, 3);
    gaussian.scale = scale;
    gaussian.opacity = opacity;
  }
  PADGS_HD Vec3<T> column(const float *p, int k) const {
    return {constant(p[k], mean.x), constant(p[4 + k], mean.x), constant(p[8 + k], mean.x)};
  }
};

// Offset of the centre of a footprint; zeros without one.
template <class T>
struct MeanOffset {
  T u, v;
};

// A footprint, and whatever its box needs. Begins as `Footprint` does; project.cpp takes it apart by lanes.
template <class T>
struct Projected {
  T shape[11];
  T log2_opacity, depth;
  T drawn;       // 1 or 0: solid, in front, within reach, and nothing overflowed on the way
  // Planar: half_u, half_v, uu, uv, vv, det; projective: range on the panorama (4), or mean (3) and cone (9).
  T bounds[12];
};

template <class T>
PADGS_HD T log2_of_opacity(T opacity) { return logarithm2(larger(opacity, constant(1e-30f, opacity))); }

// The q above which nothing is drawn, (1 - s) q + s q^2 = 2 ln(255 o) with the steepness s; negative where nothing is.
template <class T>
PADGS_HD T largest_q(T opacity, float steepness) {
  const T k = (log2_of_opacity(opacity) + 7.994353437f) * (1.0f / kHalfLog2E);
  const float linear = 1.0f - steepness;
  return 2.0f * k / (linear + root(larger(linear * linear + 4.0f * steepness * k, constant(0.0f, k))));
}

template <class T>
PADGS_HD T is_drawn(const Projected<T> &p, int bounds, T opacity, T in_front) {
  T total = magnitude(p.shape[0]);
  for (int k = 1; k < 11; ++k) total = total + magnitude(p.shape[k]);
  for (int k = 0; k < bounds; ++k) total = total + magnitude(p.bounds[k]);
  const T zero = constant(0.0f, opacity), one = constant(1.0f, opacity), largest = constant(3e38f, opacity);
  const T finite = where(below(total, largest), one, zero);  // and not NaN: those are not below anything
  const T ahead = where(below(zero, in_front), finite, zero);
  const T solid = where(below(opacity, one * kAlphaMin), zero, ahead);
  const T far_enough = where(below(p.depth, one * kNearest), zero, solid);
  return where(below(one * kFurthest, p.depth), zero, where(below(opacity, largest), far_enough, zero));
}

template <class T, class Chart>
PADGS_HD Projected<T> projected_planar(const Camera &camera, const Chart &chart, const CameraGaussian<T> &g,
                                       MeanOffset<T> offset) {
  const Covariance2D<T> s = project_covariance(g.spread(), chart.jacobian_u, chart.jacobian_v, camera.low_pass);
  const T u = chart.u + offset.u * (0.5f * float(camera.width)), v = chart.v + offset.v * (0.5f * float(camera.height));
  const T log2_opacity = log2_of_opacity(g.opacity), zero = constant(0.0f, u);
  const PlanarShape<T> shape = planar_shape(s, log2_opacity);
  Projected<T> p{{u, v, shape.a, shape.b, shape.c, zero, zero, zero, zero, zero, zero}, log2_opacity, chart.depth, zero,
                 {shape.half_u, shape.half_v, s.uu, s.uv, s.vv, s.determinant, zero, zero, zero, zero, zero, zero}};
  p.drawn = is_drawn(p, 6, g.opacity, chart.in_front(camera.near_radius));
  return p;
}

// Whether the pixels of a projective footprint follow from its range on a panorama.
PADGS_HD bool by_range(const Camera &camera) { return camera.model != kPinholeModel && !camera.square; }

template <class T>
PADGS_HD Projected<T> projected_rays(const Camera &camera, const ProjectiveShape<T> &s, Vec3<T> mean, const Mat3<T> &k,
                                     T opacity, T depth, T in_front) {
  const T zero = constant(0.0f, depth);
  Projected<T> p{{s.l0.x, s.l0.y, s.l0.z, s.l1.x, s.l1.y, s.l1.z, s.m.x, s.m.y, s.m.z, s.kappa, s.near_ratio},
                 log2_of_opacity(opacity), depth, in_front,
                 {mean.x, mean.y, mean.z, k.c0.x, k.c0.y, k.c0.z, k.c1.x, k.c1.y, k.c1.z, k.c2.x, k.c2.y, k.c2.z}};
  p.drawn = is_drawn(p, 12, opacity, in_front);
  if (!by_range(camera)) return p;
  const SphereFrame<T> frame = sphere_frame(mean);
  const PixelRangeOf<T> range =
      sphere_range(ConeOf<T>{k, frame.normal}, frame, float(camera.width), float(camera.height));
  const T bounds[12] = {range.u0, range.u1, range.v0, range.v1, zero, zero, zero, zero, zero, zero, zero, zero};
  for (int i = 0; i < 12; ++i) p.bounds[i] = bounds[i];
  return p;
}

// The offset of a projective footprint moves the mean itself, by the same share of the image on a panorama.
template <class T>
PADGS_HD Vec3<T> shifted_mean(Vec3<T> mean, MeanOffset<T> offset) {
  const SphereFrame<T> f = sphere_frame(mean);
  return mean + scaled(offset.u * kPi * f.r * f.cos_latitude, f.east) + scaled(offset.v * (0.5f * kPi) * f.r, f.down);
}

// Footprint and bounds of a Gaussian in the camera frame; its mean includes the offset.
template <class T>
PADGS_HD Projected<T> projected(const Camera &camera, const CameraGaussian<T> &posed, MeanOffset<T> offset) {
  const CameraGaussian<T> g = Widened<T>(camera, posed).gaussian;
  if (camera.projection == kErp) return projected_planar(camera, ErpChart<T>(camera, g.mean), g, offset);
  if (camera.projection == kPinhole) return projected_planar(camera, PinholeChart<T>(camera, g.mean), g, offset);
  const T exact = largest_q(g.opacity, camera.steepness), k = larger(exact, constant(0.0f, exact)) * kSlack;
  if (camera.projection == kTangent) {
    const TangentModel<T> model(g, camera.low_pass);
    const T in_front = model.frame.r - camera.near_radius;
    Mat3<T> bounds = model.cone(k);
    if (camera.square) bounds.c2 = model.published_extent(camera, posed.mean);  // the cone leaves it empty
    return projected_rays(camera, model.shape(), posed.mean, bounds, g.opacity, model.frame.r, in_front);
  }
  const RayModel<T> model(g);  // not drawn from inside: rho^2 <= the largest q
  T in_front = smaller(model.frame.r - camera.near_radius, model.rho * model.rho - exact);
  if (camera.cull_ellipsoids) {
    const Vec3<T> along = transposed_times(g.spread(), model.frame.normal);
    const T reach = model.frame.r - root(larger(exact, constant(0.0f, exact)) * dot(along, along));
    in_front = smaller(in_front, reach - camera.near_radius);
  }
  return projected_rays(camera, model.shape(g, camera.near_radius), posed.mean, model.cone(g, k), g.opacity,
                        model.frame.r, in_front);
}

// The box of a Gaussian that is drawn, from the first two values of its shape and its bounds.
PADGS_HD PixelBox box_of(const Camera &camera, const float *shape, const float *b) {
  if (planar(camera.projection)) {
    const float u = shape[0], v = shape[1];
    if (camera.square) return square_box(camera, u, v, 0.5f * (b[2] + b[4]), b[5]);
    const float half_u = b[0] * kSlack + kSlackPixels, half_v = b[1] * kSlack + kSlackPixels;
    return pixel_box(camera, {u - half_u, u + half_u, v - half_v, v + half_v});
  }
  if (camera.model == kTableModel && camera.off_panorama < 0) return {0, camera.width, 0, 0, camera.height};
  if (by_range(camera)) {
    const PixelRange range{b[0], b[1], b[2], b[3]};
    if (camera.model == kPanoramaModel) return pixel_box(camera, range);
    return pixel_box(camera, widened_range(range, camera.off_panorama, float(camera.width), float(camera.height)));
  }
  const Vec3<float> mean{b[0], b[1], b[2]};
  if (camera.square) {
    const ErpChart<float> chart(camera, mean);
    return square_box(camera, chart.u, chart.v, b[9], b[10]);
  }
  const SphereFrame<float> frame = sphere_frame(mean);
  const Cone cone{{{b[3], b[4], b[5]}, {b[6], b[7], b[8]}, {b[9], b[10], b[11]}}, frame.normal};
  return misses_pinhole(cone, camera) ? no_pixels() : pixel_box(camera, pinhole_range(cone, camera));
}

// Gradients of the inputs of one Gaussian. `camera` is by the Gaussian in the camera frame.
template <class T>
struct InputGradient {
  CameraGaussianGradient<T> camera;
  Vec3<T> mean;
  Quaternion<T> quat;
  T opacity;
  MeanOffset<T> offset;
};

template <class T, class Chart>
PADGS_HD void planar_backward(const Camera &camera, const Chart &chart, const CameraGaussian<T> &g, const T *m,
                              InputGradient<T> &out) {
  const Covariance2D<T> s = project_covariance(g.spread(), chart.jacobian_u, chart.jacobian_v, camera.low_pass);
  PlanarGradient<T> f = planar_gradient(s, m);
  f.depth = m[13];
  out.camera = planar_vjp(g, chart, f);
  out.camera.log_opacity = m[0];
  out.offset = {f.u * (0.5f * float(camera.width)), f.v * (0.5f * float(camera.height))};
}

template <class T>
PADGS_HD void projective_backward(const Camera &camera, const CameraGaussian<T> &g, const T *m, InputGradient<T> &out) {
  const ProjectiveSums<T> gradient_sums = projective_sums(m);
  out.camera = camera.projection == kTangent ? TangentModel<T>(g, camera.low_pass).vjp(g, gradient_sums, m[13])
                                             : RayModel<T>(g).vjp(g, gradient_sums, m[13]);
  const SphereFrame<T> f = sphere_frame(g.mean);  // the offset moves along it, which changes no radius: no widening
  out.offset = {dot(out.camera.mean, f.east) * f.r * f.cos_latitude * kPi,
               dot(out.camera.mean, f.down) * f.r * (0.5f * kPi)};
}

template <class T>
PADGS_HD T kept(T on, T value) { return where(below(constant(0.0f, on), on), value, constant(0.0f, on)); }
template <class T>
PADGS_HD Vec3<T> kept(T on, Vec3<T> v) { return {kept(on, v.x), kept(on, v.y), kept(on, v.z)}; }

// From the gradient sums [kGradientSums] of a Gaussian; its mean includes the offset. Where `on` is 0 it drew
// nothing and may hold anything, infinities too: its gradients are replaced by 0, not multiplied.
template <class T>
PADGS_HD InputGradient<T> gradient_of(const Camera &camera, const PosedGaussian<T> &posed, const T *m, T on) {
  const CameraGaussian<T> &g = posed.gaussian;
  const Widened<T> wide(camera, g);
  InputGradient<T> out;
  if (camera.projection == kErp)
    planar_backward(camera, ErpChart<T>(camera, g.mean), wide.gaussian, m, out);
  else if (camera.projection == kPinhole)
    planar_backward(camera, PinholeChart<T>(camera, g.mean), wide.gaussian, m, out);
  else
    projective_backward(camera, wide.gaussian, m, out);
  wide.vjp(g, out.camera);
  CameraGaussianGradient<T> &c = out.camera;
  c.mean = kept(on, c.mean);
  c.scale = kept(on, c.scale);
  c.orientation = {kept(on, c.orientation.c0), kept(on, c.orientation.c1), kept(on, c.orientation.c2)};
  out.mean = transposed_times(posed.camera, c.mean);
  const Mat3<T> turned{transposed_times(posed.camera, c.orientation.c0),
                       transposed_times(posed.camera, c.orientation.c1),
                       transposed_times(posed.camera, c.orientation.c2)};
  const Quaternion<T> q = rotation_vjp(posed.unit, posed.norm, turned);
  out.quat = {kept(on, q.w), kept(on, q.x), kept(on, q.y), kept(on, q.z)};
  out.opacity = kept(on, c.log_opacity / g.opacity);
  out.offset = {kept(on, out.offset.u), kept(on, out.offset.v)};
  return out;
}

// dL/d[R | t], by rows: mean_cam = R mean + t and orientation = R R_q, so
// dL/dR = grad_mean mean^T + grad_orientation R_q^T; 0 where `on` is, whatever the Gaussian holds.
template <class T>
PADGS_HD void pose_gradient(const PosedGaussian<T> &posed, const CameraGaussianGradient<T> &g, T on, T *pose) {
  const Mat3<T> local = rotation(posed.unit);
  const Vec3<T> a = g.mean, m = posed.mean;
  const Mat3<T> &o = g.orientation;
  const T rows[3][4] = {{a.x, o.c0.x, o.c1.x, o.c2.x}, {a.y, o.c0.y, o.c1.y, o.c2.y}, {a.z, o.c0.z, o.c1.z, o.c2.z}};
  for (int k = 0; k < 3; ++k) {
    const T *r = rows[k];
    pose[4 * k] = kept(on, r[0] * m.x + r[1] * local.c0.x + r[2] * local.c1.x + r[3] * local.c2.x);
    pose[4 * k + 1] = kept(on, r[0] * m.y + r[1] * local.c0.y + r[2] * local.c1.y + r[3] * local.c2.y);
    pose[4 * k + 2] = kept(on, r[0] * m.z + r[1] * local.c0.z + r[2] * local.c1.z + r[3] * local.c2.z);
    pose[4 * k + 3] = r[0];
  }
}

}  // namespace padgs
