// The mathematics of one Gaussian: world -> camera -> footprint on the panorama, and the derivatives of all that.
// Shared by the CPU library and the CUDA library (PADGS_HD), so what the CPU tests prove also stands there.
// Formulas: paper Eq. 2, 3, 6, 7; second derivatives of the panoramic map in closed form.
#pragma once

#include <cmath>

#include "abi.h"

#if defined(__CUDACC__)
#define PADGS_HD __host__ __device__ inline
#else
#define PADGS_HD inline
#endif

namespace padgs {

constexpr float kPi = 3.14159265358979323846f;
constexpr float kMinCosLatitude = 1e-4f;  // nearer to the axis an erp footprint is undefined: held constant, no gradient

struct Vec3 {
  float x, y, z;
};
PADGS_HD Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
PADGS_HD Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
PADGS_HD Vec3 operator*(float s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
PADGS_HD float dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
PADGS_HD Vec3 cross(Vec3 a, Vec3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

// A 3x3 matrix by columns.
struct Mat3 {
  Vec3 c0, c1, c2;
};
PADGS_HD Vec3 operator*(const Mat3 &m, Vec3 v) { return v.x * m.c0 + v.y * m.c1 + v.z * m.c2; }
PADGS_HD Vec3 transposed_times(const Mat3 &m, Vec3 v) { return {dot(m.c0, v), dot(m.c1, v), dot(m.c2, v)}; }
PADGS_HD Mat3 operator*(const Mat3 &a, const Mat3 &b) { return {a * b.c0, a * b.c1, a * b.c2}; }

struct Quat {
  float w, x, y, z;
};
PADGS_HD Quat normalized(Quat q, float &norm) {
  norm = std::sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
  const float inverse = 1.0f / std::fmax(norm, 1e-12f);
  return {q.w * inverse, q.x * inverse, q.y * inverse, q.z * inverse};
}
PADGS_HD Mat3 rotation(Quat q) {
  return {{1 - 2 * (q.y * q.y + q.z * q.z), 2 * (q.x * q.y + q.w * q.z), 2 * (q.x * q.z - q.w * q.y)},
          {2 * (q.x * q.y - q.w * q.z), 1 - 2 * (q.x * q.x + q.z * q.z), 2 * (q.y * q.z + q.w * q.x)},
          {2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x * q.x + q.y * q.y)}};
}
// dL/dq of the raw quaternion from dL/dR (by columns), through the normalisation.
PADGS_HD Quat rotation_vjp(Quat q, float norm, const Mat3 &g) {
  Quat d{2 * (q.x * (g.c1.z - g.c2.y) + q.y * (g.c2.x - g.c0.z) + q.z * (g.c0.y - g.c1.x)),
         2 * (q.y * (g.c0.y + g.c1.x) + q.z * (g.c0.z + g.c2.x) + q.w * (g.c1.z - g.c2.y)) - 4 * q.x * (g.c1.y + g.c2.z),
         2 * (q.x * (g.c0.y + g.c1.x) + q.z * (g.c1.z + g.c2.y) + q.w * (g.c2.x - g.c0.z)) - 4 * q.y * (g.c0.x + g.c2.z),
         2 * (q.x * (g.c0.z + g.c2.x) + q.y * (g.c1.z + g.c2.y) + q.w * (g.c0.y - g.c1.x)) - 4 * q.z * (g.c0.x + g.c1.y)};
  const float along = d.w * q.w + d.x * q.x + d.y * q.y + d.z * q.z, inverse = 1.0f / std::fmax(norm, 1e-12f);
  return {(d.w - along * q.w) * inverse, (d.x - along * q.x) * inverse, (d.y - along * q.y) * inverse,
          (d.z - along * q.z) * inverse};
}

// A Gaussian in the camera frame: mean, and A with Sigma = A A^T.
struct CameraGaussian {
  Vec3 mean;
  Mat3 spread;       // A = R_cam * R(q) * diag(scale)
  Mat3 orientation;  // R_cam * R(q)
};

PADGS_HD CameraGaussian to_camera(const float *pose, Vec3 mean, Quat unit, Vec3 scale) {
  const Mat3 r{{pose[0], pose[4], pose[8]}, {pose[1], pose[5], pose[9]}, {pose[2], pose[6], pose[10]}};
  const Mat3 orientation = r * rotation(unit);
  return {r * mean + Vec3{pose[3], pose[7], pose[11]},
          {scale.x * orientation.c0, scale.y * orientation.c1, scale.z * orientation.c2},
          orientation};
}

// The panoramic chart at a mean: local frame, Jacobian rows (pixels per unit length), all that the derivatives need.
struct Chart {
  float r, cos_latitude, sin_latitude;
  Vec3 normal, east, down;
  float per_east, per_down;  // J = [per_east * east ; per_down * down]
  bool near_axis;
};

PADGS_HD Chart chart_at(Vec3 mean, float width, float height) {
  Chart chart;
  const float rho2 = mean.x * mean.x + mean.z * mean.z;
  chart.r = std::sqrt(rho2 + mean.y * mean.y);
  const float rho = std::sqrt(rho2), inverse_r = 1.0f / chart.r;
  chart.normal = inverse_r * mean;
  chart.sin_latitude = mean.y * inverse_r;
  chart.cos_latitude = rho * inverse_r;
  chart.east = rho > 0 ? Vec3{mean.z / rho, 0, -mean.x / rho} : Vec3{1, 0, 0};
  chart.down = {chart.sin_latitude * chart.east.z, chart.cos_latitude, -chart.sin_latitude * chart.east.x};
  chart.near_axis = rho2 < kMinCosLatitude * kMinCosLatitude * (rho2 + mean.y * mean.y);
  chart.per_east = width / (2 * kPi) * inverse_r / std::fmax(chart.cos_latitude, kMinCosLatitude);
  chart.per_down = height / kPi * inverse_r;
  return chart;
}

// The projected covariance S = P P^T + low_pass I with P = J A, as its rows and entries.
struct Covariance2D {
  Vec3 row_u, row_v;  // P
  float uu, uv, vv, determinant;
};

PADGS_HD Covariance2D project_covariance(const Chart &chart, const Mat3 &spread, float low_pass) {
  Covariance2D s;
  s.row_u = chart.per_east * transposed_times(spread, chart.east);
  s.row_v = chart.per_down * transposed_times(spread, chart.down);
  const float uu = dot(s.row_u, s.row_u), vv = dot(s.row_v, s.row_v);
  s.uv = dot(s.row_u, s.row_v);
  const Vec3 minors = cross(s.row_u, s.row_v);  // Lagrange: uu vv - uv^2 = |P_u x P_v|^2, without the difference
  s.determinant = dot(minors, minors) + low_pass * (uu + vv) + low_pass * low_pass;
  s.uu = uu + low_pass;
  s.vv = vv + low_pass;
  return s;
}

// Upstream gradients of one footprint.
struct FootprintGradient {
  float u, v;         // dL/d(projected mean)
  float uu, uv, vv;   // dL/dS as a symmetric matrix: dL = uu dS_uu + 2 uv dS_uv + vv dS_vv
  float depth;        // dL/dr
};

// dL/dmean and dL/dA in the camera frame.
PADGS_HD void footprint_vjp(const Chart &chart, const Covariance2D &s, const Mat3 &spread, const FootprintGradient &g,
                            Vec3 &grad_mean, Mat3 &grad_spread) {
  const Vec3 grad_row_u = 2 * g.uu * s.row_u + 2 * g.uv * s.row_v;
  const Vec3 grad_row_v = 2 * g.uv * s.row_u + 2 * g.vv * s.row_v;
  const Vec3 jacobian_u = chart.per_east * chart.east, jacobian_v = chart.per_down * chart.down;
  grad_spread = {grad_row_u.x * jacobian_u + grad_row_v.x * jacobian_v,
                 grad_row_u.y * jacobian_u + grad_row_v.y * jacobian_v,
                 grad_row_u.z * jacobian_u + grad_row_v.z * jacobian_v};
  if (chart.near_axis) {
    grad_mean = {0, 0, 0};
    return;
  }
  // Rows of dL/dJ, then the Hessians of u and v applied to them:
  //   H_u = (per_east / r) [-n e^T - e n^T + tan(latitude) (d e^T + e d^T)]
  //   H_v = -(per_down / r) [n d^T + d n^T + tan(latitude) e e^T]          n normal, e east, d down
  const Vec3 grad_ju = spread * grad_row_u, grad_jv = spread * grad_row_v;
  const float tangent = chart.sin_latitude / chart.cos_latitude;
  const float u_n = dot(grad_ju, chart.normal), u_e = dot(grad_ju, chart.east), u_d = dot(grad_ju, chart.down);
  const float v_n = dot(grad_jv, chart.normal), v_e = dot(grad_jv, chart.east), v_d = dot(grad_jv, chart.down);
  const float hu = chart.per_east / chart.r, hv = chart.per_down / chart.r;
  const float along_normal = -hu * u_e - hv * v_d + g.depth;
  const float along_east = hu * (tangent * u_d - u_n) - hv * tangent * v_e + chart.per_east * g.u;
  const float along_down = hu * tangent * u_e - hv * v_n + chart.per_down * g.v;
  grad_mean = along_normal * chart.normal + along_east * chart.east + along_down * chart.down;
}

}  // namespace padgs
