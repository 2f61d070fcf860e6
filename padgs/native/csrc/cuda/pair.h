// One footprint at one pixel, as blending evaluates it, and the moments that its derivative sums; pixels.h of the CPU
// library has the same for sixteen pixels of a row.
#pragma once

#include "../mathematics/footprint.h"

namespace padgs {

constexpr float kLog2AlphaMin = -7.994353437f;  // log2(1 / 255)

struct PlanarPair {
  static constexpr int kSums = 6;
  float t, dv, log2_alpha;
  bool reached;

  PADGS_HD float distance(const Footprint &f, bool) const { return f.depth; }
  PADGS_HD float pull(const Footprint &, float) const { return 0.0f; }  // is asked of `ray` only

  // Sums of M times 1, t, dv, t^2, t dv, dv^2 with t = a du + b dv; see planar.h.
  PADGS_HD void add(float m, float *sums) const {
    const float mt = m * t, mv = m * dv;
    sums[0] += m, sums[1] += mt, sums[2] += mv;
    sums[3] += mt * t, sums[4] += mt * dv, sums[5] += mv * dv;
  }
};

struct ProjectivePair {
  static constexpr int kSums = 10;
  float q, cx, cy, log2_alpha;
  float b_by_d;
  bool reached;

  // Where the Gaussian lies on the ray: for projection `ray` at its largest value there, |M^-1 mean| b / D; else at its
  // mean.
  PADGS_HD float distance(const Footprint &f, bool largest) const {
    return largest ? b_by_d / root(f.shape[9]) : f.depth;
  }

  // e = c_x l0 + c_y l1 - q m, which the derivatives of one pixel are made of.
  PADGS_HD Vec3<float> slope(const Footprint &f) const {
    const float *s = f.shape;
    return scaled(cx, {s[0], s[1], s[2]}) + scaled(cy, {s[3], s[4], s[5]}) - scaled(q, {s[6], s[7], s[8]});
  }
  // |dL/dmean| of one pixel, the covariance held: |M h| with h = -sqrt(kappa) e (projective.h).
  PADGS_HD float pull(const Footprint &f, float m) const {
    const Vec3<float> e = slope(f);
    return magnitude(m) * root(dot(e, e) * f.shape[9]);
  }

  PADGS_HD void add(float m, float *sums) const {
    const float w0 = m * q, w1 = m * cx, w2 = m * cy;
    sums[0] += m, sums[1] += w0, sums[2] += w1, sums[3] += w2;
    sums[4] += w0 * q, sums[5] += w0 * cx, sums[6] += w0 * cy;
    sums[7] += w1 * cx, sums[8] += w1 * cy, sums[9] += w2 * cy;
  }
};

struct PlanarPixel {
  typedef PlanarPair Pair;
  float u, v, width, turns;

  PADGS_HD PlanarPixel(const Rays &, int wrap, int columns, int x, int y)
      : u(float(x) + 0.5f), v(float(y) + 0.5f), width(float(columns)), turns(wrap ? 1.0f / float(columns) : 0.0f) {}

  PADGS_HD PlanarPair at(const Footprint &f) const {
    const float offset = u - f.shape[0];
    const float du = offset - floored(offset * turns + 0.5f) * width;  // from the nearest copy across the seam
    PlanarPair p;
    p.dv = v - f.shape[1];
    p.t = f.shape[2] * du + f.shape[3] * p.dv;
    const float cross = f.shape[4] * p.dv;
    p.log2_alpha = (f.log2_opacity - cross * cross) - p.t * p.t;
    p.reached = p.log2_alpha >= kLog2AlphaMin;
    return p;
  }
};

struct ProjectivePixel {
  typedef ProjectivePair Pair;
  Vec3<float> ray;

  PADGS_HD ProjectivePixel(const Rays &rays, int, int columns, int x, int y) {
    if (rays.table) {
      const int64_t stride = int64_t(chunks(columns)) * kTile;
      const float *at = rays.table + 3 * stride * y + x;
      ray = {at[0], at[stride], at[2 * stride]};
    } else {
      const float flat = rays.row_cosine[y];
      ray = {flat * rays.column_sine[x], rays.row_sine[y], flat * rays.column_cosine[x]};
    }
  }

  PADGS_HD ProjectivePair at(const Footprint &f) const {
    const float *s = f.shape;
    const float x = dot({s[0], s[1], s[2]}, ray), y = dot({s[3], s[4], s[5]}, ray), b = dot({s[6], s[7], s[8]}, ray);
    const float n = x * x + y * y;
    const float d = larger(b * b + n * s[9], 1e-30f);  // rays across the tangent plane have none
    const float inverse = 1.0f / d;
    ProjectivePair p;
    p.q = n * inverse;
    p.b_by_d = b * inverse;
    p.cx = x * p.b_by_d;
    p.cy = y * p.b_by_d;
    p.log2_alpha = f.log2_opacity - p.q * kHalfLog2E;
    p.reached = p.log2_alpha >= kLog2AlphaMin && b > 0 && b > d * s[10];
    return p;
  }

  // dq/dd = 2 (b / D) e, and M is worth -M/2 of dL/dq.
  PADGS_HD Vec3<float> ray_gradient(const Footprint &f, const ProjectivePair &p, float m) const {
    return scaled(-(m * p.b_by_d), p.slope(f));
  }
};

}  // namespace padgs
