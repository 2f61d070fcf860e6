// One footprint over the sixteen pixels of a patch: its evaluation and its gradient sums.
//
// Two kinds: planar footprints live in pixel coordinates, projective ones on the directions of the pixels.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "../abi.h"
#include "simd_math.h"
#include "tiles.h"

namespace padgs {
namespace PADGS_ISA {

const float kLog2AlphaMin = -7.994353437f;  // log2(1 / 255)
const float kLeastLog2Alpha = -64;  // bounds what is far away, whose exponential would be denormal, which is slow
const float kHalfLog2 = 0.72134752044448170f;  // log2(e) / 2

// Rows of 16 floats for each row of patches: where its lanes are.
alignas(64) static const float kLaneX[kLanes] = {0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3, 4, 5, 6, 7};
alignas(64) static const float kLaneY[kLanes] = {0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1};

// A planar footprint as one tile sees it: of the copies across the seam, the one nearest to the tile.
struct PlanarFootprint {
  float u, v, a, b, c, log2_opacity;
  float red, green, blue, depth;
  float turns, width;  // of the seam, where pixels of the tile are nearest to different copies; else 0

  static constexpr bool kOfRays = false;
  struct Place {  // centres of the pixels
    Vec x, y;
    Place(const BlendArguments &, const Patch &patch)
        : x(load(kLaneX) + (float(patch.x0) + 0.5f)), y(load(kLaneY) + (float(patch.y0) + 0.5f)) {}
  };
  struct Factors {
    Vec t, dv;
  };
  struct At {
    Mask reached;
    Vec log2_alpha;
    Factors factors;
  };

  PlanarFootprint() = default;
  PlanarFootprint(const Footprint &f, const BlendArguments &args, const Tile &tile)
      : u(f.shape[0]), v(f.shape[1]), a(f.shape[2]), b(f.shape[3]), c(f.shape[4]), log2_opacity(f.log2_opacity),
        red(f.red), green(f.green), blue(f.blue), depth(f.depth), turns(0), width(float(args.grid.width)) {
    if (!args.wrap) return;
    const float half = 0.5f * float(tile.columns), away = float(tile.x0) + half - u;
    u += std::floor(away / width + 0.5f) * width;
    // The copies meet half a turn away. Only those that reach so far, |du| = sqrt(k (b^2 + c^2)) / (a c), can tell.
    const float limit = 0.99f * (0.5f * width - half), reach = a * c * limit;
    if (limit <= 0 || (log2_opacity - kLog2AlphaMin) * (b * b + c * c) >= reach * reach) turns = 1 / width;
  }
  PADGS_ALWAYS_INLINE At at(const Place &place) const {
    Vec du = place.x - u;
    if (turns != 0) du = du - round_down(du * turns + 0.5f) * width;
    At at;
    const Vec dv = place.y - v, t = du * a + dv * b, cross = dv * c;
    at.factors = {t, dv};
    at.log2_alpha = maximum((log2_opacity - cross * cross) - t * t, splat(kLeastLog2Alpha));
    at.reached = at_least(at.log2_alpha, splat(kLog2AlphaMin));
    return at;
  }

  // Sums of M times 1, t, dv, t^2, t dv, dv^2, with t = a du + b dv and not du: where a footprint is long and oblique,
  // those of du nearly cancel in every derivative.
  struct GradientSums {
    Vec one = zero(), t = zero(), v = zero(), tt = zero(), tv = zero(), vv = zero();
    explicit GradientSums(const PlanarFootprint &) {}
    PADGS_ALWAYS_INLINE void add(const Factors &at, Vec m) {
      const Vec mt = m * at.t, mv = m * at.dv;
      one += m, t += mt, v += mv;
      tt += mt * at.t, tv += mt * at.dv, vv += mv * at.dv;
    }
    void finish(Vec *out) const {
      out[0] = one, out[1] = t, out[2] = v, out[3] = tt, out[4] = tv, out[5] = vv;
      for (int k = 6; k < 10; ++k) out[k] = zero();
    }
  };
};

// q from (x, y) = L d and b = m.d. With the steepness s, alpha = opacity exp(-f(q) / 2) and f(q) = (1 - s) q + s q^2.
struct ProjectiveFootprint {
  Footprint f;
  float red, green, blue, depth, steepness;

  static constexpr bool kOfRays = true;
  struct Place {  // directions of the pixels, or derivatives by them
    Vec x = zero(), y = zero(), z = zero();
    Place() = default;
    Place(const BlendArguments &args, const Patch &patch) {
      const Rays &rays = args.rays;
      float lanes[3][kLanes];
      for (int y = 0; y < kPatchHeight; ++y) {
        const int row = std::min(patch.y0 + y, args.grid.height - 1);  // beyond the image any direction will do
        for (int x = 0; x < kPatchWidth; ++x) {
          const int lane = y * kPatchWidth + x, column = patch.x0 + x;
          if (rays.table) {
            for (int axis = 0; axis < 3; ++axis)
              lanes[axis][lane] = rays.table[(3 * int64_t(row) + axis) * padded(patch.width) + column];
          } else {  // (cos(lat) sin(lon), sin(lat), cos(lat) cos(lon)) on a panorama
            lanes[0][lane] = rays.row_cosine[row] * rays.column_sine[column];
            lanes[1][lane] = rays.row_sine[row];
            lanes[2][lane] = rays.row_cosine[row] * rays.column_cosine[column];
          }
        }
      }
      x = load(lanes[0]), y = load(lanes[1]), z = load(lanes[2]);
    }
    static int64_t padded(int width) { return int64_t(width + kTile - 1) / kTile * kTile; }
  };
  struct Factors {
    Vec q, cx, cy;  // (q, x b / D, y b / D)
  };
  struct At {
    Mask reached;
    Vec log2_alpha;
    Factors factors;
    Vec b_by_d;  // b / D
  };

  ProjectiveFootprint() = default;
  ProjectiveFootprint(const Footprint &footprint, const BlendArguments &args, const Tile &)
      : f(footprint), red(f.red), green(f.green), blue(f.blue), depth(f.depth), steepness(args.steepness) {}
  PADGS_ALWAYS_INLINE At at(const Place &p) const {
    const float *s = f.shape;
    const Vec x = p.x * s[0] + p.y * s[1] + p.z * s[2], y = p.x * s[3] + p.y * s[4] + p.z * s[5];
    const Vec b = p.x * s[6] + p.y * s[7] + p.z * s[8];
    const Vec n = x * x + y * y;
    const Vec d = maximum(b * b + n * s[9], splat(1e-30f));  // rays across the tangent plane have none
    const Vec inverse = reciprocal(d);
    At at;
    at.b_by_d = b * inverse;
    at.factors = {n * inverse, x * at.b_by_d, y * at.b_by_d};
    const Vec exponent = at.factors.q * ((1 - steepness) + at.factors.q * steepness) * kHalfLog2;
    at.log2_alpha = maximum(f.log2_opacity - exponent, splat(kLeastLog2Alpha));
    at.reached = both(at_least(at.log2_alpha, splat(kLog2AlphaMin)), both(less(zero(), b), less(d * s[10], b)));
    return at;
  }
  // e = c_x l0 + c_y l1 - q m, which the derivatives of one pixel are made of.
  PADGS_ALWAYS_INLINE Place slope(const Factors &at) const {
    const float *s = f.shape;
    Place e;
    e.x = at.cx * s[0] + at.cy * s[3] - at.q * s[6];
    e.y = at.cx * s[1] + at.cy * s[4] - at.q * s[7];
    e.z = at.cx * s[2] + at.cy * s[5] - at.q * s[8];
    return e;
  }
  // f'(q).
  PADGS_ALWAYS_INLINE static Vec derivative(float steepness, Vec q) { return (1 - steepness) + q * (2 * steepness); }
  // dq/dd = 2 (b / D) e, and M is worth -M/2 of dL/df.
  PADGS_ALWAYS_INLINE void add_ray_gradient(const Factors &at, Vec b_by_d, Vec m, Place &grad) const {
    const Vec scale = -(m * derivative(steepness, at.q) * b_by_d);
    const Place e = slope(at);
    grad.x += scale * e.x, grad.y += scale * e.y, grad.z += scale * e.z;
  }
  // |dL/dmean| of each pixel, the covariance held: |M h| with h = -sqrt(kappa) e (projective.h).
  PADGS_ALWAYS_INLINE Vec absgrad(const Factors &at, Vec m) const {
    const Place e = slope(at);
    return magnitude(m) * derivative(steepness, at.q) * root((e.x * e.x + e.y * e.y + e.z * e.z) * f.shape[9]);
  }

  struct GradientSums {
    Vec m = zero(), c0 = zero(), c1 = zero(), c2 = zero();
    Vec c00 = zero(), c01 = zero(), c02 = zero(), c11 = zero(), c12 = zero(), c22 = zero();
    float steepness;
    explicit GradientSums(const ProjectiveFootprint &seen) : steepness(seen.steepness) {}
    PADGS_ALWAYS_INLINE void add(const Factors &at, Vec weight) {
      m += weight;
      weight = weight * derivative(steepness, at.q);
      const Vec w0 = weight * at.q, w1 = weight * at.cx, w2 = weight * at.cy;
      c0 += w0, c1 += w1, c2 += w2;
      c00 += w0 * at.q, c01 += w0 * at.cx, c02 += w0 * at.cy;
      c11 += w1 * at.cx, c12 += w1 * at.cy, c22 += w2 * at.cy;
    }
    void finish(Vec *out) const {
      out[0] = m, out[1] = c0, out[2] = c1, out[3] = c2, out[4] = c00;
      out[5] = c01, out[6] = c02, out[7] = c11, out[8] = c12, out[9] = c22;
    }
  };
};

// Where all patches of a tile are; those of this thread's tile, until it asks for the next.
template <class Seen>
std::vector<typename Seen::Place> &places_of(const BlendArguments &args, const Tile &tile) {
  static thread_local std::vector<typename Seen::Place> places;
  places.clear();
  for (int p = 0; p < tile.patches(); ++p) places.emplace_back(args, Patch(tile, p, args.grid.width));
  return places;
}

// Gradients of the directions of a tile's pixels, [H, 3, padded W]; each pixel is in one tile.
inline void add_ray_gradients(const BlendGradientArguments &args, const Tile &tile,
                              const std::vector<ProjectiveFootprint::Place> &gradients) {
  const int width = args.forward.grid.width;
  const int64_t stride = ProjectiveFootprint::Place::padded(width);
  for (int p = 0; p < tile.patches(); ++p) {
    float lanes[3][kLanes];
    store(lanes[0], gradients[p].x), store(lanes[1], gradients[p].y), store(lanes[2], gradients[p].z);
    Patch(tile, p, width).each_pixel([&](int lane, int64_t pixel) {
      float *out = args.grad_rays + pixel / width * 3 * stride + pixel % width;
      for (int axis = 0; axis < 3; ++axis) out[axis * stride] += lanes[axis][lane];
    });
  }
}

}  // namespace PADGS_ISA
}  // namespace padgs
