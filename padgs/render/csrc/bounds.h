// Which pixels a footprint can reach with alpha >= 1/255. May be too large, never too small.
//
// On the sphere the reached rays form a cone, described by its dual K* = M M^T - n n^T with n the direction of the mean:
// the plane through the camera with normal w touches it iff w^T K* w = 0. M and n stay apart: the square of a small M
// would drown in the rounding of n n^T. Extremes of (a.x) / (b.x) over the cone are the roots t of
//   (b^T K* b) t^2 - 2 (a^T K* b) t + a^T K* a = 0,   valid iff b^T K* b < 0 (the cone lies in front of the plane b.x = 0),
// with the discriminant |M^T w|^2 - |M^T a x M^T b|^2, w = (n.b) a - (n.a) b, where nothing of order 1 cancels.
#pragma once

#include <initializer_list>

#include "abi.h"
#include "vector3.h"

namespace padgs {

constexpr float kSlack = 1.0001f;  // rounding must never cost a contribution
constexpr float kSlackPixels = 2e-3f;

// Continuous pixel ranges of one footprint; u is not reduced modulo the width.
struct PixelRange {
  float u0, u1, v0, v1;
};

struct Cone {
  Mat3<float> spread;  // M
  Vec3<float> normal;  // n
};

PADGS_HD bool ratio_range(const Cone &k, Vec3<float> a, Vec3<float> b, float &low, float &high) {
  const Vec3<float> p = transposed_times(k.spread, a), q = transposed_times(k.spread, b);
  const float na = dot(k.normal, a), nb = dot(k.normal, b);
  const float bb = dot(q, q) - nb * nb, ab = dot(p, q) - na * nb;
  if (!(bb < 0)) return false;
  const Vec3<float> w = scaled(nb, p) - scaled(na, q), minors = cross(p, q);
  const float spread = root(larger(dot(w, w) - dot(minors, minors), 0.0f));
  low = (ab + spread) / bb;
  high = (ab - spread) / bb;
  return true;
}

// The latitude-longitude box of a cone on a panorama. Longitude is exact, latitude conservative.
PADGS_HD PixelRange sphere_range(const Cone &k, const SphereFrame<float> &f, float width, float height) {
  const float c = f.cos_latitude, s = f.sin_latitude;
  const Vec3<float> ahead{f.normal.x, 0, f.normal.z};
  const float norm = root(dot(ahead, ahead));
  const Vec3<float> h = norm > 0 ? scaled(1 / norm, ahead) : Vec3<float>{0, 0, 1};
  // Longitude: the meridian plane at offset delta touches iff b_tt cot^2 - 2 b_rt cot + b_rr = 0.
  const Vec3<float> along_t = transposed_times(k.spread, f.east), along_r = transposed_times(k.spread, h);
  const Vec3<float> minors = cross(along_t, along_r);
  const float b_tt = dot(along_t, along_t), b_rt = dot(along_r, along_t);  // n is orthogonal to east
  const float disc = c * c * b_tt - dot(minors, minors);
  const bool over_pole = !(disc > 1e-7f * b_rt * b_rt) || !(b_tt > 0) || norm == 0;
  float west = -kPi, east = kPi;
  if (!over_pole) {
    east = arctangent2(1.0f, (b_rt + root(disc)) / b_tt);
    west = arctangent2(1.0f, (b_rt - root(disc)) / b_tt) - kPi;
  }
  // Latitude, over the tangent-plane box [x0, x1] x [y0, y1] of the cone.
  float x0, x1, y0, y1, low = -1, high = 1;
  if (ratio_range(k, f.east, f.normal, x0, x1) && ratio_range(k, f.down, f.normal, y0, y1)) {
    const float reach = larger(magnitude(x0), magnitude(x1));
    low = 1, high = -1;
    for (const float y : {y0, y1}) {
      const float rise = s + c * y, flat = rise / root(1 + y * y), bent = rise / root(1 + reach * reach + y * y);
      low = smaller(low, rise > 0 ? bent : flat);
      high = larger(high, rise > 0 ? flat : bent);
    }
    const bool passes = over_pole || c - s * (s > 0 ? y1 : y0) <= 0;
    if (passes && s >= 0) high = 1;
    if (passes && s <= 0) low = -1;
  }
  const float longitude = arctangent2(f.normal.x, f.normal.z);
  const float per_radian_u = width / (2 * kPi), per_radian_v = height / kPi;
  const float widen_u = kSlackPixels + (kSlack - 1) * (east - west) * per_radian_u;
  const float top = asinf(smaller(larger(low, -1.0f), 1.0f)), bottom = asinf(smaller(larger(high, -1.0f), 1.0f));
  const float widen_v = kSlackPixels + (kSlack - 1) * (bottom - top) * per_radian_v;
  return {(longitude + west) * per_radian_u + 0.5f * width - widen_u, (longitude + east) * per_radian_u + 0.5f * width + widen_u,
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

// Whether a cone misses a pinhole image: it lies behind the camera, or beside one of the four sides of the image. Most of
// what is neither before nor behind the camera does, and would else be given the whole image below.
PADGS_HD bool misses_pinhole(const Cone &k, const Camera &camera) {
  const float right = float(camera.width) - camera.cx, bottom = float(camera.height) - camera.cy;
  return behind(k, {0, 0, 1}) || behind(k, {camera.fx, 0, camera.cx}) || behind(k, {-camera.fx, 0, right}) ||
         behind(k, {0, camera.fy, camera.cy}) || behind(k, {0, -camera.fy, bottom});
}

// The box of a cone in a pinhole image; the whole image where the cone is not strictly in front of the camera.
PADGS_HD PixelRange pinhole_range(const Cone &k, const Camera &camera) {
  PixelRange range{0, float(camera.width), 0, float(camera.height)};
  float low, high;
  if (ratio_range(k, {1, 0, 0}, {0, 0, 1}, low, high)) {
    const float widen = kSlackPixels + (kSlack - 1) * (high - low) * camera.fx;
    range.u0 = camera.fx * low + camera.cx - widen, range.u1 = camera.fx * high + camera.cx + widen;
  }
  if (ratio_range(k, {0, 1, 0}, {0, 0, 1}, low, high)) {
    const float widen = kSlackPixels + (kSlack - 1) * (high - low) * camera.fy;
    range.v0 = camera.fy * low + camera.cy - widen, range.v1 = camera.fy * high + camera.cy + widen;
  }
  return range;
}

}  // namespace padgs
