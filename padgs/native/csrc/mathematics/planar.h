// Planar footprints: a 2D Gaussian in pixels through the Jacobian of the camera at the mean (paper Eq. 3 and 5).
// `erp` is the panoramic chart, `pinhole` the perspective one; they differ in the Jacobian and its derivative only.
#pragma once

#include "../abi.h"
#include "vector3.h"

namespace padgs {

constexpr float kMinCosLatitude = 1e-4f;  // nearer to the axis erp footprints are undefined: held constant, no gradient
constexpr float kHalfLog2E = 0.72134752044448170f;
constexpr float kSlopeLimit = 1.3f;  // pinhole: slopes in the Jacobian are limited to this times the half field of view

// dL of a footprint: by its centre, by the rows of P in S = P P^T + low_pass I, and by its depth.
template <class T>
struct PlanarGradient {
  T u, v;
  Vec3<T> row_u, row_v;
  T depth;
};

// The projected covariance S = P P^T + low_pass I with P = J A.
template <class T>
struct Covariance2D {
  Vec3<T> row_u, row_v;  // of P
  T uu, uv, vv, determinant;
};
template <class T>
PADGS_HD Covariance2D<T> project_covariance(const Mat3<T> &spread, Vec3<T> jacobian_u, Vec3<T> jacobian_v,
                                            float low_pass) {
  Covariance2D<T> s;
  s.row_u = transposed_times(spread, jacobian_u);
  s.row_v = transposed_times(spread, jacobian_v);
  const T uu = dot(s.row_u, s.row_u), vv = dot(s.row_v, s.row_v);
  const Vec3<T> minors = cross(s.row_u, s.row_v);  // Lagrange: uu vv - uv^2 = |P_u x P_v|^2, without the difference
  s.uv = dot(s.row_u, s.row_v);
  s.determinant = dot(minors, minors) + low_pass * (uu + vv) + low_pass * low_pass;
  s.uu = uu + low_pass;
  s.vv = vv + low_pass;
  return s;
}

// A chart of the camera at a mean: pixel, Jacobian rows in pixels per unit length, and r.
template <class T>
struct ErpChart {
  SphereFrame<T> frame;
  T u, v, depth, per_east, per_down;
  Vec3<T> jacobian_u, jacobian_v;
  T flat;  // 1 where the footprint is held constant, next to the axis

  PADGS_HD ErpChart(const Camera &camera, Vec3<T> mean) : frame(sphere_frame(mean)) {
    const float width = float(camera.width), height = float(camera.height);
    const T rho2 = mean.x * mean.x + mean.z * mean.z;
    depth = frame.r;
    u = (arctangent2(mean.x, mean.z) * (0.5f / kPi) + 0.5f) * width;
    v = (arctangent2(mean.y, root(rho2)) * (1.0f / kPi) + 0.5f) * height;
    const T least = constant(kMinCosLatitude, u);
    per_east = width / (2 * kPi) / (frame.r * larger(frame.cos_latitude, least));
    per_down = height / kPi / frame.r;
    jacobian_u = scaled(per_east, frame.east);
    jacobian_v = scaled(per_down, frame.down);
    flat = where(below(rho2, kMinCosLatitude * kMinCosLatitude * (rho2 + mean.y * mean.y)), constant(1.0f, u),
                 constant(0.0f, u));
  }
  PADGS_HD T in_front(float near_radius) const { return depth - near_radius; }  // drawn where > 0

  // dL/dmean from dL/d(u, v), dL/dr and the rows of dL/dJ, by the Hessians of u and v:
  //   H_u = (per_east / r) [-n e^T - e n^T + tan(latitude) (d e^T + e d^T)]
  //   H_v = -(per_down / r) [n d^T + d n^T + tan(latitude) e e^T]          n normal, e east, d down
  PADGS_HD Vec3<T> vjp(const PlanarGradient<T> &g, Vec3<T> grad_ju, Vec3<T> grad_jv) const {
    const T tangent = frame.sin_latitude / larger(frame.cos_latitude, constant(kMinCosLatitude, u));
    const T u_n = dot(grad_ju, frame.normal), u_e = dot(grad_ju, frame.east), u_d = dot(grad_ju, frame.down);
    const T v_n = dot(grad_jv, frame.normal), v_e = dot(grad_jv, frame.east), v_d = dot(grad_jv, frame.down);
    const T hu = per_east / frame.r, hv = per_down / frame.r;
    const T along_normal = g.depth - hu * u_e - hv * v_d;
    const T along_east = hu * (tangent * u_d - u_n) - hv * tangent * v_e + per_east * g.u;
    const T along_down = hu * tangent * u_e - hv * v_n + per_down * g.v;
    const T moving = 1.0f - flat;
    return scaled(moving * along_normal, frame.normal) + scaled(moving * along_east, frame.east) +
           scaled(moving * along_down, frame.down);
  }
};

template <class T>
struct PinholeChart {
  T u, v, depth, z, slope_x, slope_y, free_x, free_y;  // free: 0 where a slope is limited
  float fx, fy;
  Vec3<T> normal, jacobian_u, jacobian_v;

  PADGS_HD PinholeChart(const Camera &camera, Vec3<T> mean) : z(mean.z), fx(camera.fx), fy(camera.fy) {
    const T zero = constant(0.0f, z), one = constant(1.0f, z), inverse = 1.0f / z;
    depth = root(dot(mean, mean));
    normal = scaled(1.0f / depth, mean);
    const T x = mean.x * inverse, y = mean.y * inverse;
    u = fx * x + camera.cx;
    v = fy * y + camera.cy;
    const T limit_x = constant(kSlopeLimit * 0.5f * float(camera.width) / fx, z);
    const T limit_y = constant(kSlopeLimit * 0.5f * float(camera.height) / fy, z);
    slope_x = larger(smaller(x, limit_x), -limit_x);
    slope_y = larger(smaller(y, limit_y), -limit_y);
    free_x = where(below(limit_x, magnitude(x)), zero, one);
    free_y = where(below(limit_y, magnitude(y)), zero, one);
    jacobian_u = {fx * inverse, zero, -(fx * inverse * slope_x)};
    jacobian_v = {zero, fy * inverse, -(fy * inverse * slope_y)};
  }
  PADGS_HD T in_front(float near_radius) const { return z - near_radius; }

  PADGS_HD Vec3<T> vjp(const PlanarGradient<T> &g, Vec3<T> grad_ju, Vec3<T> grad_jv) const {
    // J_u = (fx / z) (1, 0, -a) with a = x / z, limited; J_v alike.
    const T ix = fx / z, iy = fy / z, inverse = 1.0f / z;
    const T x = (u_offset() * inverse), y = (v_offset() * inverse);
    Vec3<T> d;
    d.x = ix * g.u - ix * inverse * free_x * grad_ju.z;
    d.y = iy * g.v - iy * inverse * free_y * grad_jv.z;
    d.z = -(ix * x * g.u) - iy * y * g.v - inverse * (dot(grad_ju, jacobian_u) + dot(grad_jv, jacobian_v)) +
          ix * inverse * free_x * slope_x * grad_ju.z + iy * inverse * free_y * slope_y * grad_jv.z;
    return d + scaled(g.depth, normal);
  }
  PADGS_HD T u_offset() const { return normal.x * depth; }  // the mean's own x and y
  PADGS_HD T v_offset() const { return normal.y * depth; }
};

// The footprint as the blender evaluates it: log2(alpha) = log2_opacity - (a du + b dv)^2 - (c dv)^2, a Cholesky factor
// of the conic, so that nothing cancels. Also the half widths of the ellipse alpha = 1/255.
template <class T>
struct PlanarShape {
  T a, b, c, half_u, half_v;
};
template <class T>
PADGS_HD PlanarShape<T> planar_shape(const Covariance2D<T> &s, T log2_opacity) {
  PlanarShape<T> shape;
  const T scale = constant(0.84932180028801907f, s.uu);  // sqrt(log2(e) / 2)
  shape.a = scale * root(s.vv / s.determinant);
  shape.b = -(scale * s.uv) / root(s.vv * s.determinant);
  shape.c = scale / root(s.vv);
  // q <= k = 2 ln(255 opacity)
  const T k = larger((log2_opacity + 7.994353437f) * (1.0f / kHalfLog2E), constant(0.0f, s.uu));
  shape.half_u = root(k * s.uu);
  shape.half_v = root(k * s.vv);
  return shape;
}

// From the gradient sums of M = dL/d(ln alpha) over the pixels to the footprint's gradient. With S^-1 = K^T K, K the factor
// [[a, b], [0, c]] of planar_shape over h = sqrt(log2(e) / 2), and y = K delta:
//   dL/d(u, v) = K^T sum(M y),  dL/dS = K^T Y K / 2 with Y = sum(M y y^T),  dL/dP = K^T Y (K P),
// in this order, because S^-1 itself holds no digits where the footprint is long and oblique.
template <class T>
PADGS_HD PlanarGradient<T> planar_gradient(const Covariance2D<T> &s, const T *m) {
  const T inverse_root = 1.0f / root(s.vv), c = inverse_root;  // in units of h
  const T a = root(s.vv / s.determinant), b = -(s.uv * inverse_root) / root(s.determinant);
  const T inverse_h = constant(1.17741002251547469f, c);
  const T t = m[1] * inverse_h, w = c * m[2];
  const T tt = m[3] * inverse_h * inverse_h, tw = c * inverse_h * m[4], ww = c * c * m[5];
  const Vec3<T> q_t = scaled(a, s.row_u) + scaled(b, s.row_v), q_w = scaled(c, s.row_v);
  const Vec3<T> z_t = scaled(tt, q_t) + scaled(tw, q_w), z_w = scaled(tw, q_t) + scaled(ww, q_w);
  return {a * t, b * t + c * w, scaled(a, z_t), scaled(b, z_t) + scaled(c, z_w), constant(0.0f, c)};
}

// Back through chart and covariance to the Gaussian in the camera frame.
template <class T, class Chart>
PADGS_HD CameraGaussianGradient<T> planar_vjp(const CameraGaussian<T> &g, const Chart &chart,
                                              const PlanarGradient<T> &f) {
  CameraGaussianGradient<T> out;
  const Vec3<T> ju = chart.jacobian_u, jv = chart.jacobian_v;
  spread_vjp(g,
             Mat3<T>{scaled(f.row_u.x, ju) + scaled(f.row_v.x, jv), scaled(f.row_u.y, ju) + scaled(f.row_v.y, jv),
                     scaled(f.row_u.z, ju) + scaled(f.row_v.z, jv)},
             out);
  const Mat3<T> spread = g.spread();
  out.mean = chart.vjp(f, times(spread, f.row_u), times(spread, f.row_v));
  return out;
}

}  // namespace padgs
