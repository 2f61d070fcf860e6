// Projective footprints: one kernel for every model that works with rays. With a pixel's unit ray d,
//   n = |L d|^2,  b = m.d,  D = b^2 + kappa n,  q = n / D,  accepted where b > 0 and b > near_ratio D.
// `tangent`: the Gaussian flattened onto the tangent plane at its mean (OP43DGS, corrected). kappa = 0.
// `ray`: the largest value of the 3D Gaussian along the ray (SPaGS).
//
// Backward blending sums, over the pixels, M = dL/d(ln alpha) times 1, c and c c^T with c = (q, x b / D, y b / D) and
// (x, y) = L d. Both models' derivatives are linear in these ten sums.
#pragma once

#include "../abi.h"
#include "planar.h"
#include "vector3.h"

namespace padgs {

constexpr float kPublishedFocal = 512.0f;  // pixels per radian on the tangent planes of the released OP43DGS

template <class T>
struct ProjectiveShape {
  Vec3<T> l0, l1, m;
  T kappa, near_ratio;
};

// The ten sums, by name.
template <class T>
struct ProjectiveSums {
  T one, c0, c1, c2, c00, c01, c02, c11, c12, c22;
};
template <class T>
PADGS_HD ProjectiveSums<T> projective_sums(const T *m) {
  return {m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8], m[9]};
}

template <class T>
struct TangentModel {
  SphereFrame<T> frame;
  Vec3<T> e, d, n;    // east, down and normal rows of A / r, with Sigma = A A^T; P = (e, d), S = P P^T + low_pass I
  T c11, c21, c22;    // Cholesky factor C of S

  PADGS_HD TangentModel(const CameraGaussian<T> &g, float low_pass) : frame(sphere_frame(g.mean)) {
    const Mat3<T> spread = g.spread();
    const T inverse = 1.0f / frame.r;
    e = scaled(inverse, transposed_times(spread, frame.east));
    d = scaled(inverse, transposed_times(spread, frame.down));
    n = scaled(inverse, transposed_times(spread, frame.normal));
    const T ee = dot(e, e);
    const Vec3<T> minors = cross(e, d);
    const T determinant = dot(minors, minors) + low_pass * (ee + dot(d, d)) + low_pass * low_pass;
    c11 = root(ee + low_pass);
    c21 = dot(e, d) / c11;
    c22 = root(determinant / (ee + low_pass));
  }

  PADGS_HD ProjectiveShape<T> shape() const {
    const Vec3<T> l0 = scaled(1.0f / c11, frame.east);
    const Vec3<T> l1 = scaled(1.0f / c22, frame.down - scaled(c21, l0));
    return {l0, l1, frame.normal, constant(0.0f, c11), constant(0.0f, c11)};
  }

  // The cone of rays with q <= k has the dual K* = k E^T S E - n n^T = M M^T - n n^T; this is M.
  PADGS_HD Mat3<T> cone(T k) const {
    const T h = root(k), zero = constant(0.0f, k);
    return {scaled(h * c11, frame.east) + scaled(h * c21, frame.down), scaled(h * c22, frame.down), {zero, zero, zero}};
  }

  // Radius of the bounds of the released OP43DGS, from half a trace and a determinant in square pixels.
  // The trace is that of the footprint in the panorama, by a Jacobian whose lower row is divided by
  // sqrt(x^2 + z^2 r^2) instead of r^2 sqrt(x^2 + z^2); the determinant is that of S at 512 pixels per radian.
  // Grows with the distance.
  PADGS_HD Vec3<T> published_extent(const Camera &camera, Vec3<T> mean) const {
    const ErpChart<T> chart(camera, mean);
    const T x2 = mean.x * mean.x, z2 = mean.z * mean.z, r2 = frame.r * frame.r;
    const T wrong = r2 * root(x2 + z2) / larger(root(x2 + z2 * r2), constant(1e-20f, r2));
    const T u = chart.per_east * frame.r, v = chart.per_down * frame.r * wrong;  // pixels per radian
    const T across = kPublishedFocal * kPublishedFocal * c11 * c22;
    const T half_trace =
        0.5f * (u * u * dot(e, e) + v * v * dot(d, d)) + camera.low_pass * kPublishedFocal * kPublishedFocal;
    return {half_trace, across * across, constant(0.0f, r2)};
  }

  // With y = C^-1 tau, g = S^-1 tau = C^-T y, Y = sum M y y^T:
  //   dL/dP = C^-T Y (C^-1 P), in this order, because S^-1 itself holds no digits where S is long and oblique,
  //   dL/dA = E^T dL/dP / r,  dL/dmu = [E^T (sum M (I + tau tau^T) g - dL/dP n) - tr(P^T dL/dP) n] / r
  PADGS_HD CameraGaussianGradient<T> vjp(const CameraGaussian<T> &g, const ProjectiveSums<T> &m,
                                         T grad_depth) const {
    const T i11 = 1.0f / c11, i22 = 1.0f / c22, i21 = -(c21 * i11 * i22);  // C^-1
    const Vec3<T> q1 = scaled(i11, e), q2 = scaled(i21, e) + scaled(i22, d);
    const Vec3<T> z1 = scaled(m.c11, q1) + scaled(m.c12, q2), z2 = scaled(m.c12, q1) + scaled(m.c22, q2);
    const Vec3<T> grad_e = scaled(i11, z1) + scaled(i21, z2), grad_d = scaled(i22, z2);
    const T along_e = i11 * m.c1 + i21 * m.c2 + c11 * m.c01 - dot(grad_e, n);
    const T along_d = i22 * m.c2 + c21 * m.c01 + c22 * m.c02 - dot(grad_d, n);
    const T along_n = -(dot(q1, z1) + dot(q2, z2));
    const T inverse = 1.0f / frame.r;
    CameraGaussianGradient<T> out;
    out.mean = scaled(inverse * along_e, frame.east) + scaled(inverse * along_d, frame.down) +
               scaled(inverse * along_n + grad_depth, frame.normal);
    out.log_opacity = m.one;
    const Vec3<T> east = scaled(inverse, frame.east), down = scaled(inverse, frame.down);
    spread_vjp(g,
               Mat3<T>{scaled(grad_e.x, east) + scaled(grad_d.x, down), scaled(grad_e.y, east) + scaled(grad_d.y, down),
                       scaled(grad_e.z, east) + scaled(grad_d.z, down)},
               out);
    return out;
  }
};

template <class T>
struct RayModel {
  SphereFrame<T> frame;
  Vec3<T> o;  // M^-1 mean, the mean in whitened coordinates
  T rho;      // |o|: how many standard deviations the camera is away
  Vec3<T> o_hat, u1, u2;

  PADGS_HD explicit RayModel(const CameraGaussian<T> &g) : frame(sphere_frame(g.mean)) {
    const Vec3<T> local = transposed_times(g.orientation, g.mean);
    o = {local.x / g.scale.x, local.y / g.scale.y, local.z / g.scale.z};
    rho = root(dot(o, o));
    o_hat = scaled(1.0f / rho, o);
    // Any two unit vectors that complete o_hat: cross it with the axis it is least along.
    const T ax = magnitude(o_hat.x), ay = magnitude(o_hat.y), az = magnitude(o_hat.z);
    const T zero = constant(0.0f, rho), one = constant(1.0f, rho);
    const T least = smaller(ax, smaller(ay, az));
    const T is_x = where(below(least, ax), zero, one), is_y = (1.0f - is_x) * where(below(least, ay), zero, one);
    const Vec3<T> axis{is_x, is_y, 1.0f - is_x - is_y};
    const Vec3<T> side = cross(o_hat, axis);
    u1 = scaled(1.0f / root(dot(side, side)), side);
    u2 = cross(o_hat, u1);
  }

  // R diag(1 / scale) applied to a whitened covector: M^-T w.
  PADGS_HD Vec3<T> from_whitened(const CameraGaussian<T> &g, Vec3<T> w) const {
    return times(g.orientation, Vec3<T>{w.x / g.scale.x, w.y / g.scale.y, w.z / g.scale.z});
  }

  PADGS_HD ProjectiveShape<T> shape(const CameraGaussian<T> &g, float near_radius) const {
    return {scaled(rho, from_whitened(g, u1)), scaled(rho, from_whitened(g, u2)), from_whitened(g, o_hat),
            1.0f / (rho * rho), near_radius / rho};
  }

  // The cone of rays with q <= k has the dual K* = k Sigma / r^2 - n n^T = M M^T - n n^T; this is M.
  PADGS_HD Mat3<T> cone(const CameraGaussian<T> &g, T k) const {
    const T h = root(k) / frame.r;
    const Mat3<T> &o = g.orientation;
    return {scaled(h * g.scale.x, o.c0), scaled(h * g.scale.y, o.c1), scaled(h * g.scale.z, o.c2)};
  }

  // The closest point of a ray to the mean, in whitened space, is off by e = [o_hat u1 u2] (c0 / rho, -c1, -c2); with
  // h = M^-T e:  dL/dmu = -sum M h,  dL/dSigma = sum M h h^T / 2.
  PADGS_HD CameraGaussianGradient<T> vjp(const CameraGaussian<T> &g, const ProjectiveSums<T> &m,
                                         T grad_depth) const {
    const T inverse_rho = 1.0f / rho;
    const Mat3<T> basis{scaled(inverse_rho, o_hat), scaled(constant(-1.0f, rho), u1), scaled(constant(-1.0f, rho), u2)};
    const Vec3<T> e = times(basis, Vec3<T>{m.c0, m.c1, m.c2});
    const Vec3<T> h = from_whitened(g, e);
    // With E = sum M e e^T in whitened axes and s the scales, dL/dSigma = R diag(1/s) E diag(1/s) R^T / 2.
    const Vec3<T> r0 = times(basis, Vec3<T>{m.c00, m.c01, m.c02}), r1 = times(basis, Vec3<T>{m.c01, m.c11, m.c12});
    const Vec3<T> r2 = times(basis, Vec3<T>{m.c02, m.c12, m.c22});
    const Mat3<T> half{r0, r1, r2};  // B C, columns
    const auto entry = [&](Vec3<T> row_of_basis, Vec3<T> row_of_half) { return dot(row_of_basis, row_of_half); };
    const Vec3<T> b0{basis.c0.x, basis.c1.x, basis.c2.x}, b1{basis.c0.y, basis.c1.y, basis.c2.y};
    const Vec3<T> b2{basis.c0.z, basis.c1.z, basis.c2.z};
    const Vec3<T> h0{half.c0.x, half.c1.x, half.c2.x}, h1{half.c0.y, half.c1.y, half.c2.y};
    const Vec3<T> h2{half.c0.z, half.c1.z, half.c2.z};
    const Vec3<T> s = g.scale;
    const T ix = 1.0f / s.x, iy = 1.0f / s.y, iz = 1.0f / s.z;
    // G = R^T (dL/dSigma) R in the Gaussian's own axes.
    const T gxx = 0.5f * ix * ix * entry(b0, h0), gxy = 0.5f * ix * iy * entry(b0, h1);
    const T gyy = 0.5f * iy * iy * entry(b1, h1), gxz = 0.5f * ix * iz * entry(b0, h2);
    const T gzz = 0.5f * iz * iz * entry(b2, h2), gyz = 0.5f * iy * iz * entry(b1, h2);
    CameraGaussianGradient<T> out;
    out.log_opacity = m.one;
    out.scale = {2.0f * s.x * gxx, 2.0f * s.y * gyy, 2.0f * s.z * gzz};
    out.mean = scaled(grad_depth, frame.normal) - h;
    // dL/dR = 2 R G diag(s^2).
    const T wx = 2.0f * s.x * s.x, wy = 2.0f * s.y * s.y, wz = 2.0f * s.z * s.z;
    out.orientation = {scaled(wx, times(g.orientation, Vec3<T>{gxx, gxy, gxz})),
                       scaled(wy, times(g.orientation, Vec3<T>{gxy, gyy, gyz})),
                       scaled(wz, times(g.orientation, Vec3<T>{gxz, gyz, gzz}))};
    return out;
  }
};

}  // namespace padgs
