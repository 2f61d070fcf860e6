// Projection of all Gaussians, forward and backward: one item of work per Gaussian, no shared state.
#include <algorithm>
#include <cmath>
#include <vector>

#include "gaussian.h"

namespace padgs {
namespace {

constexpr float kSlack = 1.0001f;     // rounding must never cost a contribution
constexpr float kSlackPixels = 1e-3f;
constexpr int64_t kBlock = 1024;      // Gaussians per partial sum of the pose gradient; fixed, so that sums are too

Vec3 vec3_at(const float *p, int64_t i) { return {p[3 * i], p[3 * i + 1], p[3 * i + 2]}; }
Quat quat_at(const float *p, int64_t i) { return {p[4 * i], p[4 * i + 1], p[4 * i + 2], p[4 * i + 3]}; }

int tiles(int pixels) { return (pixels + kTile - 1) / kTile; }

float clamp(float x, float low, float high) { return std::min(std::max(x, low), high); }

// The tiles that hold pixel centres within (half_u, half_v) of (u, v); empty where none does.
TileBox exact_box(const Camera &camera, float u, float v, float half_u, float half_v) {
  const float width = float(camera.width), height = float(camera.height);
  TileBox box{0, 0, 0, 0, 0};
  const int row = int(std::ceil(clamp(v - half_v - 0.5f, -1.0f, height)));
  const int row_end = int(std::floor(clamp(v + half_v - 0.5f, -1.0f, height))) + 1;
  if (std::max(row, 0) >= std::min(row_end, camera.height)) return box;
  // Columns are not reduced modulo the width yet; a footprint is at most one turn long.
  int column = int(std::ceil(clamp(u - half_u - 0.5f, -width, 2 * width)));
  int column_end = int(std::floor(clamp(u + half_u - 0.5f, -width, 2 * width))) + 1;
  if (!camera.wrap) {
    column = std::max(column, 0);
    column_end = std::min(column_end, camera.width);
  }
  if (column >= column_end) return box;
  if (camera.wrap && column_end - column >= camera.width) {
    column = 0;
    column_end = camera.width;
  }
  const int shift = column < 0 ? camera.width : column >= camera.width ? -camera.width : 0;
  column += shift;
  column_end += shift;
  box.column = column / kTile;
  box.column_end = tiles(std::min(column_end, camera.width));
  // The piece beyond the seam; where both pieces meet in a tile it is drawn once.
  box.second_end = std::min(tiles(std::max(column_end - camera.width, 0)), box.column);
  box.row = std::max(row, 0) / kTile;
  box.row_end = tiles(std::min(row_end, camera.height));
  return box;
}

// The published bounds: a square of 3 sigma of the longest axis, rounded out to 16-pixel tiles and cut at the borders.
TileBox square_box(const Camera &camera, float u, float v, const Covariance2D &s) {
  const float middle = 0.5f * (s.uu + s.vv);
  const float longest = middle + std::sqrt(std::max(0.1f, middle * middle - (s.uu * s.vv - s.uv * s.uv)));
  const float radius = std::ceil(3.0f * std::sqrt(longest));
  const auto first = [&](float p, int pixels) {
    return int(clamp(std::floor((p - 0.5f - radius) / kTile), 0.0f, float(tiles(pixels))));
  };
  const auto end = [&](float p, int pixels) {
    return int(clamp(std::floor((p - 0.5f + radius + kTile - 1) / kTile), 0.0f, float(tiles(pixels))));
  };
  TileBox box{first(u, camera.width), end(u, camera.width), 0, first(v, camera.height), end(v, camera.height)};
  if (box.column >= box.column_end || box.row >= box.row_end) return {0, 0, 0, 0, 0};
  return box;
}

bool finite(const Covariance2D &s) {
  return std::isfinite(s.uu) && std::isfinite(s.vv) && std::isfinite(s.uv) && std::isfinite(s.determinant) &&
         s.determinant > 0;
}

void project_one(const Camera &camera, const Inputs &in, int64_t i, Footprint &f, TileBox &box) {
  f = {};
  box = {0, 0, 0, 0, 0};
  const float opacity = in.opacities[i];
  if (!(opacity >= kAlphaMin)) return;
  float norm;
  const CameraGaussian g = to_camera(camera.cam_from_world, vec3_at(in.means, i), normalized(quat_at(in.quats, i), norm),
                                     vec3_at(in.scales, i));
  if (!(dot(g.mean, g.mean) > camera.near_radius * camera.near_radius)) return;
  const float width = float(camera.width), height = float(camera.height);
  const Chart chart = chart_at(g.mean, width, height);
  const Covariance2D s = project_covariance(chart, g.spread, camera.low_pass);
  if (!finite(s)) return;
  const float rho = std::sqrt(g.mean.x * g.mean.x + g.mean.z * g.mean.z);
  f.u = (std::atan2(g.mean.x, g.mean.z) / (2 * kPi) + 0.5f) * width;
  f.v = (std::atan2(g.mean.y, rho) / kPi + 0.5f) * height;
  if (in.probe) {
    f.u += in.probe[2 * i] * 0.5f * width;
    f.v += in.probe[2 * i + 1] * 0.5f * height;
  }
  const float k = 2 * std::log(opacity * 255.0f);  // alpha >= 1/255  <=>  q <= k
  const float half_u = std::sqrt(std::max(k, 0.0f) * s.uu) * kSlack + kSlackPixels;
  const float half_v = std::sqrt(std::max(k, 0.0f) * s.vv) * kSlack + kSlackPixels;
  box = camera.square ? square_box(camera, f.u, f.v, s) : exact_box(camera, f.u, f.v, half_u, half_v);
  // q = (s_vv du^2 - 2 s_uv du dv + s_uu dv^2) / det, scaled so that exp(-q / 2) = 2^-(...)
  const float scale = std::sqrt(0.5f * 1.44269504088896f);
  f.a = scale * std::sqrt(s.vv / s.determinant);
  f.b = -scale * s.uv / std::sqrt(s.vv * s.determinant);
  f.c = scale / std::sqrt(s.vv);
  f.log2_opacity = std::log2(opacity);
  f.row_reach = half_v;
  f.depth = chart.r;
  f.red = in.colors[3 * i];
  f.green = in.colors[3 * i + 1];
  f.blue = in.colors[3 * i + 2];
  f.opacity = opacity;
}

// Moments of one Gaussian over all its instances, in the order of its slots.
void sum_moments(const float *moments, int64_t first, int64_t end, float *total) {
  std::fill_n(total, kMoments, 0.0f);
  for (int64_t slot = first; slot < end; ++slot)
    for (int k = 0; k < kMoments; ++k) total[k] += moments[slot * kMoments + k];
}

void project_backward_one(const Camera &camera, const Inputs &in, const float *m, int64_t i, const Gradients &out,
                          double *pose) {
  float norm;
  const Quat unit = normalized(quat_at(in.quats, i), norm);
  const Vec3 mean = vec3_at(in.means, i), scale = vec3_at(in.scales, i);
  const CameraGaussian g = to_camera(camera.cam_from_world, mean, unit, scale);
  const Chart chart = chart_at(g.mean, float(camera.width), float(camera.height));
  const Covariance2D s = project_covariance(chart, g.spread, camera.low_pass);
  // M = dL/d(ln alpha), ln alpha = ln o - q / 2, conic C = S^-1:
  //   dL/d(u, v) = C sum(M delta),  dL/dS = C sum(M delta delta^T) C / 2
  const float ca = s.vv / s.determinant, cb = -s.uv / s.determinant, cc = s.uu / s.determinant;
  FootprintGradient f;
  f.u = ca * m[1] + cb * m[2];
  f.v = cb * m[1] + cc * m[2];
  const float t00 = ca * m[3] + cb * m[4], t01 = ca * m[4] + cb * m[5];
  const float t10 = cb * m[3] + cc * m[4], t11 = cb * m[4] + cc * m[5];
  f.uu = 0.5f * (t00 * ca + t01 * cb);
  f.uv = 0.5f * (t00 * cb + t01 * cc);
  f.vv = 0.5f * (t10 * cb + t11 * cc);
  f.depth = m[9];
  Vec3 grad_mean;
  Mat3 grad_spread;
  footprint_vjp(chart, s, g.spread, f, grad_mean, grad_spread);

  const float *p = camera.cam_from_world;
  const Mat3 r{{p[0], p[4], p[8]}, {p[1], p[5], p[9]}, {p[2], p[6], p[10]}};
  const Vec3 world = transposed_times(r, grad_mean);
  out.means[3 * i] = world.x, out.means[3 * i + 1] = world.y, out.means[3 * i + 2] = world.z;
  out.scales[3 * i] = dot(grad_spread.c0, g.orientation.c0);
  out.scales[3 * i + 1] = dot(grad_spread.c1, g.orientation.c1);
  out.scales[3 * i + 2] = dot(grad_spread.c2, g.orientation.c2);
  const Mat3 grad_orientation{scale.x * grad_spread.c0, scale.y * grad_spread.c1, scale.z * grad_spread.c2};
  const Quat q = rotation_vjp(unit, norm,
                              {transposed_times(r, grad_orientation.c0), transposed_times(r, grad_orientation.c1),
                               transposed_times(r, grad_orientation.c2)});
  out.quats[4 * i] = q.w, out.quats[4 * i + 1] = q.x, out.quats[4 * i + 2] = q.y, out.quats[4 * i + 3] = q.z;
  out.opacities[i] = m[0] / in.opacities[i];
  out.colors[3 * i] = m[6], out.colors[3 * i + 1] = m[7], out.colors[3 * i + 2] = m[8];
  if (out.probe) {
    out.probe[2 * i] = f.u * 0.5f * float(camera.width);
    out.probe[2 * i + 1] = f.v * 0.5f * float(camera.height);
  }
  if (!pose) return;
  // mean_cam = R mean + t, A = R (R_q diag(scale)): dL/dR = grad_mean mean^T + grad_A (R_q diag(scale))^T.
  const Mat3 local = rotation(unit);
  const Vec3 columns[3] = {local.c0, local.c1, local.c2};
  const Vec3 grads[3] = {grad_orientation.c0, grad_orientation.c1, grad_orientation.c2};
  const auto add_outer = [&](Vec3 a, Vec3 b) {
    const float rows[3] = {a.x, a.y, a.z};
    for (int k = 0; k < 3; ++k) {
      pose[4 * k] += double(rows[k]) * b.x;
      pose[4 * k + 1] += double(rows[k]) * b.y;
      pose[4 * k + 2] += double(rows[k]) * b.z;
    }
  };
  add_outer(grad_mean, mean);
  for (int k = 0; k < 3; ++k) add_outer(grads[k], columns[k]);
  pose[3] += grad_mean.x, pose[7] += grad_mean.y, pose[11] += grad_mean.z;
}

}  // namespace
}  // namespace padgs

using namespace padgs;

PADGS_API void padgs_project(const Camera *camera, const Inputs *in, Footprint *footprints, TileBox *boxes) {
#pragma omp parallel for schedule(static)
  for (int64_t i = 0; i < in->count; ++i) project_one(*camera, *in, i, footprints[i], boxes[i]);
}

// Gradients of every input from the moments of the instances; slot_start [N + 1] says whose is which.
PADGS_API void padgs_project_backward(const Camera *camera, const Inputs *in, const int64_t *slot_start,
                                      const float *moments, const Gradients *out) {
  const int64_t blocks = (in->count + kBlock - 1) / kBlock;
  std::vector<double> poses(out->pose ? 12 * blocks : 0, 0.0);
#pragma omp parallel for schedule(dynamic, 4)
  for (int64_t block = 0; block < blocks; ++block) {
    double *pose = out->pose ? poses.data() + 12 * block : nullptr;
    for (int64_t i = block * kBlock; i < std::min(in->count, (block + 1) * kBlock); ++i) {
      if (slot_start[i] == slot_start[i + 1]) continue;  // the caller has filled the outputs with zeros
      float total[kMoments];
      sum_moments(moments, slot_start[i], slot_start[i + 1], total);
      project_backward_one(*camera, *in, total, i, *out, pose);
    }
  }
  if (!out->pose) return;
  std::fill_n(out->pose, 12, 0.0);
  for (int64_t block = 0; block < blocks; ++block)
    for (int k = 0; k < 12; ++k) out->pose[k] += poses[12 * block + k];
}
