// Vectors, 3x3 matrices and quaternions of any scalar type, and the Gaussian in the camera frame (paper Eq. 2).
#pragma once

#include "scalar.h"

namespace padgs {

template <class T>
struct Vec3 {
  T x, y, z;
};
template <class T>
PADGS_HD Vec3<T> operator+(Vec3<T> a, Vec3<T> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class T>
PADGS_HD Vec3<T> operator-(Vec3<T> a, Vec3<T> b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <class T>
PADGS_HD Vec3<T> scaled(T s, Vec3<T> a) { return {s * a.x, s * a.y, s * a.z}; }
template <class T>
PADGS_HD T dot(Vec3<T> a, Vec3<T> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class T>
PADGS_HD Vec3<T> cross(Vec3<T> a, Vec3<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// By columns.
template <class T>
struct Mat3 {
  Vec3<T> c0, c1, c2;
};
template <class T>
PADGS_HD Vec3<T> times(const Mat3<T> &m, Vec3<T> v) {
  return scaled(v.x, m.c0) + scaled(v.y, m.c1) + scaled(v.z, m.c2);
}
template <class T>
PADGS_HD Vec3<T> transposed_times(const Mat3<T> &m, Vec3<T> v) { return {dot(m.c0, v), dot(m.c1, v), dot(m.c2, v)}; }
template <class T>
PADGS_HD Mat3<T> times(const Mat3<T> &a, const Mat3<T> &b) { return {times(a, b.c0), times(a, b.c1), times(a, b.c2)}; }

template <class T>
struct Quaternion {
  T w, x, y, z;
};
template <class T>
PADGS_HD Quaternion<T> normalized(Quaternion<T> q, T &norm) {
  norm = larger(root(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z), constant(1e-12f, q.w));
  const T inverse = 1.0f / norm;
  return {q.w * inverse, q.x * inverse, q.y * inverse, q.z * inverse};
}
template <class T>
PADGS_HD Mat3<T> rotation(Quaternion<T> q) {
  const T xx = 2.0f * q.x * q.x, yy = 2.0f * q.y * q.y, zz = 2.0f * q.z * q.z;
  const T xy = 2.0f * q.x * q.y, xz = 2.0f * q.x * q.z, yz = 2.0f * q.y * q.z;
  const T wx = 2.0f * q.w * q.x, wy = 2.0f * q.w * q.y, wz = 2.0f * q.w * q.z;
  return {{1.0f - yy - zz, xy + wz, xz - wy}, {xy - wz, 1.0f - xx - zz, yz + wx}, {xz + wy, yz - wx, 1.0f - xx - yy}};
}
// dL/dq of the raw quaternion from dL/dR, through the normalisation; q is the unit one.
template <class T>
PADGS_HD Quaternion<T> rotation_vjp(Quaternion<T> q, T norm, const Mat3<T> &g) {
  const T wx = g.c1.z - g.c2.y, wy = g.c2.x - g.c0.z, wz = g.c0.y - g.c1.x;
  const T xy = g.c0.y + g.c1.x, xz = g.c0.z + g.c2.x, yz = g.c1.z + g.c2.y;
  const Quaternion<T> d{2.0f * (q.x * wx + q.y * wy + q.z * wz),
                        2.0f * (q.w * wx + q.y * xy + q.z * xz) - 4.0f * q.x * (g.c1.y + g.c2.z),
                        2.0f * (q.w * wy + q.x * xy + q.z * yz) - 4.0f * q.y * (g.c0.x + g.c2.z),
                        2.0f * (q.w * wz + q.x * xz + q.y * yz) - 4.0f * q.z * (g.c0.x + g.c1.y)};
  const T along = d.w * q.w + d.x * q.x + d.y * q.y + d.z * q.z, inverse = 1.0f / norm;
  return {(d.w - along * q.w) * inverse, (d.x - along * q.x) * inverse, (d.y - along * q.y) * inverse,
          (d.z - along * q.z) * inverse};
}

// A Gaussian in the camera frame: Sigma = A A^T with A = orientation diag(scale).
template <class T>
struct CameraGaussian {
  Vec3<T> mean;
  Mat3<T> orientation;  // R_cam R(q)
  Vec3<T> scale;
  T opacity;
  PADGS_HD Mat3<T> spread() const {
    return {scaled(scale.x, orientation.c0), scaled(scale.y, orientation.c1), scaled(scale.z, orientation.c2)};
  }
};

// Its gradient.
template <class T>
struct CameraGaussianGradient {
  Vec3<T> mean;
  Mat3<T> orientation;
  Vec3<T> scale;
  T log_opacity;
};

// dL/dorientation and dL/dscale from dL/dA.
template <class T>
PADGS_HD void spread_vjp(const CameraGaussian<T> &g, const Mat3<T> &grad_spread, CameraGaussianGradient<T> &out) {
  out.orientation = {scaled(g.scale.x, grad_spread.c0), scaled(g.scale.y, grad_spread.c1),
                     scaled(g.scale.z, grad_spread.c2)};
  out.scale = {dot(grad_spread.c0, g.orientation.c0), dot(grad_spread.c1, g.orientation.c1),
               dot(grad_spread.c2, g.orientation.c2)};
}

// Longitude, latitude and the frame of the sphere at a direction: n outwards, east, down.
template <class T>
struct SphereFrame {
  T r, cos_latitude, sin_latitude;
  Vec3<T> normal, east, down;
};
template <class T>
PADGS_HD SphereFrame<T> sphere_frame(Vec3<T> p) {
  SphereFrame<T> f;
  const T zero = constant(0.0f, p.x), one = constant(1.0f, p.x);
  const T rho2 = p.x * p.x + p.z * p.z, rho = root(rho2);
  f.r = root(rho2 + p.y * p.y);
  const T inverse = 1.0f / f.r, inverse_rho = 1.0f / where(below(zero, rho), rho, one);
  f.normal = scaled(inverse, p);
  f.sin_latitude = p.y * inverse;
  f.cos_latitude = rho * inverse;
  f.east = {where(below(zero, rho), p.z * inverse_rho, one), zero, -(p.x * inverse_rho)};  // camera x on the axis
  f.down = {f.sin_latitude * f.east.z, f.cos_latitude, -(f.sin_latitude * f.east.x)};
  return f;
}

}  // namespace padgs
