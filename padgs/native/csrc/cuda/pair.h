// One footprint at one pixel, as blending evaluates it, and its gradient sums; pixels.h of the CPU
// library has the same for sixteen pixels of a row. Where a product meets a sum it says which way: forward and backward
// must agree to the last bit on drawn pairs, but a compiler may fuse one and not the other.
#pragma once

#include "../mathematics/footprint.h"
#include "device.cuh"

namespace padgs {

constexpr float kLog2AlphaMin = -7.994353437f;  // log2(1 / 255)

struct PlanarPair {
  static constexpr int kGradientSums = 6;
  float t, dv, log2_alpha;
  bool reached;

  __device__ float distance(const Footprint &f, bool) const { return f.depth; }
  __device__ float absgrad(const Footprint &, float) const { return 0.0f; }  // used for `ray` only

  // M times 1, t, dv, t^2, t dv, dv^2 with t = a du + b dv; see planar.h.
  __device__ void gradient_sums(float m, float *out) const {
    const float mt = m * t, mv = m * dv;
    out[0] = m, out[1] = mt, out[2] = mv;
    out[3] = mt * t, out[4] = mt * dv, out[5] = mv * dv;
  }
};

struct ProjectivePair {
  static constexpr int kGradientSums = 10;
  float q, cx, cy, log2_alpha;
  float b_by_d;
  float derivative;  // f'(q) of the exponent -f(q) / 2, f(q) = (1 - s) q + s q^2 with the steepness s
  bool reached;

  // Where the Gaussian lies on the ray: for projection `ray` at its largest value there, |M^-1 mean| b / D; else at its
  // mean.
  __device__ float distance(const Footprint &f, bool largest) const {
    return largest ? b_by_d / root(f.shape[9]) : f.depth;
  }

  // e = c_x l0 + c_y l1 - q m, which the derivatives of one pixel are made of.
  __device__ Vec3<float> slope(const Footprint &f) const {
    const float *s = f.shape;
    return scaled(cx, {s[0], s[1], s[2]}) + scaled(cy, {s[3], s[4], s[5]}) - scaled(q, {s[6], s[7], s[8]});
  }
  // |dL/dmean| of one pixel, the covariance held: |M h| with h = -sqrt(kappa) e (projective.h).
  __device__ float absgrad(const Footprint &f, float m) const {
    const Vec3<float> e = slope(f);
    return magnitude(m) * derivative * root(dot(e, e) * f.shape[9]);
  }

  // M times 1, and times f'(q), c and c c^T with c = (q, c_x, c_y); see projective.h.
  __device__ void gradient_sums(float m, float *out) const {
    const float w0 = m * derivative * q, w1 = m * derivative * cx, w2 = m * derivative * cy;
    out[0] = m, out[1] = w0, out[2] = w1, out[3] = w2;
    out[4] = w0 * q, out[5] = w0 * cx, out[6] = w0 * cy;
    out[7] = w1 * cx, out[8] = w1 * cy, out[9] = w2 * cy;
  }
};

struct PlanarPixel {
  typedef PlanarPair Pair;
  float u, v, width, turns;

  __device__ PlanarPixel(const Rays &, float, int wrap, int columns, int x, int y)
      : u(float(x) + 0.5f), v(float(y) + 0.5f), width(float(columns)), turns(wrap ? 1.0f / float(columns) : 0.0f) {}

  __device__ PlanarPair at(const Footprint &f) const {
    const float offset = u - f.shape[0];
    const float du = fmaf(-floored(fmaf(offset, turns, 0.5f)), width, offset);  // from the nearest copy across the seam
    PlanarPair p;
    p.dv = v - f.shape[1];
    p.t = fmaf(f.shape[2], du, f.shape[3] * p.dv);
    const float cross = f.shape[4] * p.dv;
    p.log2_alpha = fmaf(-p.t, p.t, fmaf(-cross, cross, f.log2_opacity));
    p.reached = p.log2_alpha >= kLog2AlphaMin;
    return p;
  }
};

struct ProjectivePixel {
  typedef ProjectivePair Pair;
  Vec3<float> ray;
  float steepness;

  __device__ ProjectivePixel(const Rays &rays, float steep, int, int columns, int x, int y) : steepness(steep) {
    if (rays.table) {
      const int64_t stride = int64_t(chunks(columns)) * kTile;
      const float *at = rays.table + 3 * stride * y + x;
      ray = {at[0], at[stride], at[2 * stride]};
    } else {
      const float flat = rays.row_cosine[y];
      ray = {flat * rays.column_sine[x], rays.row_sine[y], flat * rays.column_cosine[x]};
    }
  }

  __device__ float along(const float *v) const { return fmaf(v[0], ray.x, fmaf(v[1], ray.y, v[2] * ray.z)); }

  __device__ ProjectivePair at(const Footprint &f) const {
    const float *s = f.shape;
    const float x = along(s), y = along(s + 3), b = along(s + 6), n = fmaf(x, x, y * y);
    const float d = larger(fmaf(b, b, n * s[9]), 1e-30f);  // rays across the tangent plane have none
    const float inverse = quick_inverse(d);
    ProjectivePair p;
    p.q = n * inverse;
    p.b_by_d = b * inverse;
    p.cx = x * p.b_by_d;
    p.cy = y * p.b_by_d;
    p.derivative = fmaf(2 * steepness, p.q, 1 - steepness);
    p.log2_alpha = fmaf(-p.q * fmaf(steepness, p.q, 1 - steepness), kHalfLog2E, f.log2_opacity);
    p.reached = p.log2_alpha >= kLog2AlphaMin && b > 0 && b > d * s[10];
    return p;
  }

  // dq/dd = 2 (b / D) e, and M is worth -M/2 of dL/df.
  __device__ Vec3<float> ray_gradient(const Footprint &f, const ProjectivePair &p, float m) const {
    return scaled(-(m * p.derivative * p.b_by_d), p.slope(f));
  }
};

}  // namespace padgs
