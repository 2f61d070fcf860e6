// Which pixels a footprint can reach with alpha >= 1/255. May be too large, never too small.
//
// On the sphere the reached rays form a cone, described by its dual K* = M M^T - n n^T with n the direction of the
// mean: the plane through the camera with normal w touches it iff w^T K* w = 0. M and n stay apart: the square of a
// small M would drown in the rounding of n n^T. Extremes of (a.x) / (b.x) over the cone are the roots t of
//   (b^T K* b) t^2 - 2 (a^T K* b) t + a^T K* a = 0,   valid iff b^T K* b < 0 (the cone is before the plane b.x = 0),
// with the discriminant |M^T w|^2 - |M^T a x M^T b|^2, w = (n.b) a - (n.a) b, where nothing of order 1 cancels.
#pragma once

#include <initializer_list>

#include "../abi.h"
#include "vector3.h"

namespace padgs {

constexpr float kSlack = 1.0001f;  // rounding must never cost a contribution
constexpr float kSlackPixels = 2e-3f;

// Continuous pixel ranges of one footprint; u is not reduced modulo the width.
template <class T>
struct PixelRangeOf {
  T u0, u1, v0, v1;
};
using PixelRange = PixelRangeOf<float>;

template <class T>
struct ConeOf {
  Mat3<T> spread;  // M
  Vec3<T> normal;  // n
};
using Cone = ConeOf<float>;

// Extremes of (a.x) / (b.x); they mean something where the b^T K* b that it returns is negative.
template <class T>
PADGS_HD T ratio_range(const ConeOf<T> &k, Vec3<T> a, Vec3<T> b, T &low, T &high) {
  const Vec3<T> p = transposed_times(k.spread, a), q = transposed_times(k.spread, b);
  const T na = dot(k.normal, a), nb = dot(k.normal, b), zero = constant(0.0f, na);
  const T bb = dot(q, q) - nb * nb, ab = dot(p, q) - na * nb, some = where(below(bb, zero), bb, constant(-1.0f, na));
  const Vec3<T> w = scaled(nb, p) - scaled(na, q), minors = cross(p, q);
  const T spread = root(larger(dot(w, w) - dot(minors, minors), zero));
  low = (ab + spread) / some;
  high = (ab - spread) / some;
  return bb;
}

template <class T>
PADGS_HD T arcsine(T x) {
  const T one = constant(1.0f, x), inside = smaller(larger(x, -one), one);
  return arctangent2(inside, root((one - inside) * (one + inside)));
}

// The latitude-longitude box of a cone on a panorama. Longitude is exact, latitude conservative. Without branches, so
// that it serves many cones at a time.
template <class T>
PADGS_HD PixelRangeOf<T> sphere_range(const ConeOf<T> &k, const SphereFrame<T> &f, float width, float height) {
  const T c = f.cos_latitude, s = f.sin_latitude, zero = constant(0.0f, c), one = constant(1.0f, c);
  const Vec3<T> ahead{f.normal.x, zero, f.normal.z};
  const T norm = root(dot(ahead, ahead)), inverse = one / where(below(zero, norm), norm, one);
  const Vec3<T> h{ahead.x * inverse, zero, where(below(zero, norm), ahead.z * inverse, one)};
  // Longitude: the meridian plane at offset delta touches iff b_tt cot^2 - 2 b_rt cot + b_rr = 0.
  const Vec3<T> along_t = transposed_times(k.spread, f.east), along_r = transposed_times(k.spread, h);
  const Vec3<T> minors = cross(along_t, along_r);
  const T b_tt = dot(along_t, along_t), b_rt = dot(along_r, along_t);  // n is orthogonal to east
  const T disc = c * c * b_tt - dot(minors, minors);
  T over_pole = where(below(1e-7f * b_rt * b_rt, disc), zero, one);
  over_pole = where(below(zero, b_tt), where(below(zero, norm), over_pole, one), one);
  const T half_chord = root(larger(disc, zero)), across = where(below(zero, b_tt), b_tt, one);
  const T half_turn = constant(kPi, c);
  const T east = where(below(zero, over_pole), half_turn, arctangent2(one, (b_rt + half_chord) / across));
  const T west = where(below(zero, over_pole), -half_turn, arctangent2(one, (b_rt - half_chord) / across) - kPi);
  // Latitude, over the tangent-plane box [x0, x1] x [y0, y1] of the cone.
  T x0, x1, y[2];
  const T bounded_x = ratio_range(k, f.east, f.normal, x0, x1);
  const T bounded_y = ratio_range(k, f.down, f.normal, y[0], y[1]);
  const T reach = larger(magnitude(x0), magnitude(x1));
  T low = one, high = -one;
  for (int i = 0; i < 2; ++i) {
    const T rise = s + c * y[i], square = y[i] * y[i];
    const T flat = rise / root(one + square), bent = rise / root(one + reach * reach + square);
    low = smaller(low, where(below(zero, rise), bent, flat));
    high = larger(high, where(below(zero, rise), flat, bent));
  }
  // The box of tangents holds the pole on the mean's side, and with it all rays around.
  const T towards_pole = where(below(zero, s), y[1], y[0]);
  const T passes = where(below(zero, c - s * towards_pole), over_pole, one);
  high = where(below(s, zero), high, where(below(zero, passes), one, high));
  low = where(below(zero, s), low, where(below(zero, passes), -one, low));
  low = where(below(bounded_x, zero), where(below(bounded_y, zero), low, -one), -one);
  high = where(below(bounded_x, zero), where(below(bounded_y, zero), high, one), one);
  const T longitude = arctangent2(f.normal.x, f.normal.z);
  const float per_radian_u = width / (2 * kPi), per_radian_v = height / kPi;
  const T widen_u = (east - west) * ((kSlack - 1) * per_radian_u) + kSlackPixels;
  const T top = arcsine(low), bottom = arcsine(high);
  const T widen_v = (bottom - top) * ((kSlack - 1) * per_radian_v) + kSlackPixels;
  return {(longitude + west) * per_radian_u + 0.5f * width - widen_u,
          (longitude + east) * per_radian_u + 0.5f * width + widen_u,
          top * per_radian_v + 0.5f * height - widen_v, bottom * per_radian_v + 0.5f * height + widen_v};
}

// The range of a panorama within `angle` of any direction of a range: a disc about latitude psi spans asin(sin(angle) /
// cos(psi)) of longitude to each side, and all of it once it reaches a pole.
PADGS_HD PixelRange widened_range(PixelRange r, float angle, float width, float height) {
  const float per_radian_u = width / (2 * kPi), per_radian_v = height / kPi;
  const float steepest = larger(magnitude(r.v0 - 0.5f * height), magnitude(r.v1 - 0.5f * height)) / per_radian_v;
  r.v0 -= angle * per_radian_v + kSlackPixels, r.v1 += angle * per_radian_v + kSlackPixels;
  if (steepest + angle >= 0.5f * kPi - 1e-3f) return {0, width, r.v0, r.v1};
  const float aside = asinf(smaller(sinf(angle) / cosf(steepest), 1.0f)) * per_radian_u * kSlack + kSlackPixels;
  return {r.u0 - aside, r.u1 + aside, r.v0, r.v1};
}

// Whether a cone lies strictly on the side of a plane through the camera that the plane's normal turns away from.
PADGS_HD bool behind(const Cone &k, Vec3<float> plane) {
  const Vec3<float> p = transposed_times(k.spread, plane);
  const float n = dot(k.normal, plane);
  return n < 0 && dot(p, p) * kSlack < n * n;
}

// Whether a cone misses a pinhole image: it lies behind the camera, or beside one of the four sides of the image.
// Most Gaussians beside the camera do, and would otherwise get the whole image below.
PADGS_HD bool misses_pinhole(const Cone &k, const Camera &camera) {
  const float right = float(camera.width) - camera.cx, bottom = float(camera.height) - camera.cy;
  return behind(k, {0, 0, 1}) || behind(k, {camera.fx, 0, camera.cx}) || behind(k, {-camera.fx, 0, right}) ||
         behind(k, {0, camera.fy, camera.cy}) || behind(k, {0, -camera.fy, bottom});
}

// The box of a cone in a pinhole image; the whole image where the cone is not strictly in front of the camera.
PADGS_HD PixelRange pinhole_range(const Cone &k, const Camera &camera) {
  PixelRange range{0, float(camera.width), 0, float(camera.height)};
  float low, high;
  if (ratio_range<float>(k, {1, 0, 0}, {0, 0, 1}, low, high) < 0) {
    const float widen = kSlackPixels + (kSlack - 1) * (high - low) * camera.fx;
    range.u0 = camera.fx * low + camera.cx - widen, range.u1 = camera.fx * high + camera.cx + widen;
  }
  if (ratio_range<float>(k, {0, 1, 0}, {0, 0, 1}, low, high) < 0) {
    const float widen = kSlackPixels + (kSlack - 1) * (high - low) * camera.fy;
    range.v0 = camera.fy * low + camera.cy - widen, range.v1 = camera.fy * high + camera.cy + widen;
  }
  return range;
}

}  // namespace padgs
