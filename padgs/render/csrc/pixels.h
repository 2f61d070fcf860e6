// One footprint along the rows of one 16-pixel-wide chunk: what blending evaluates, and the moments it sums.
//
// Three kinds: planar footprints in pixel coordinates; projective ones on a panorama, where a ray is a product of sines
// and cosines of its column and its row; projective ones with a table of rays.
#pragma once

#include "abi.h"
#include "simd.h"

namespace padgs {
namespace PADGS_ISA {

const float kLog2AlphaMin = -7.994353437f;  // log2(1 / 255)
const float kHalfLog2 = 0.72134752044448170f;  // log2(e) / 2

struct PlanarPixels {
  Vec a_du;
  float v, b, c, log2_opacity;

  struct Row {
    Mask reached;
    Vec log2_alpha;
    float dv;
  };

  PlanarPixels(const Footprint &f, const BlendArguments &args, int x0)
      : v(f.shape[1]), b(f.shape[3]), c(f.shape[4]), log2_opacity(f.log2_opacity) {
    const Vec offset = iota() + (float(x0) + 0.5f - f.shape[0]);
    // With wrap, the nearest copy of the Gaussian across the seam.
    const float width = float(args.grid.width), turns = args.wrap ? 1.0f / width : 0.0f;
    a_du = (offset - round_down(offset * turns + 0.5f) * width) * f.shape[2];
  }
  Row row(const BlendArguments &, int y) const {
    Row at;
    at.dv = float(y) + 0.5f - v;
    const Vec t = a_du + b * at.dv;
    const float cross = c * at.dv;
    at.log2_alpha = (log2_opacity - cross * cross) - t * t;
    at.reached = at_least(at.log2_alpha, splat(kLog2AlphaMin));
    return at;
  }
  void add_ray_gradient(const Footprint &, const Row &, Vec, float *, int, int) const {}

  // Sums of M times 1, t, dv, t^2, t dv, dv^2, with t = a du + b dv and not du: where a footprint is long and oblique,
  // those of du nearly cancel in every derivative. du is the same in all rows of a chunk and waits until these are summed.
  struct ChunkMoments {
    Vec m0 = zero(), m1 = zero(), m2 = zero();
    void add(const Row &at, Vec m) {
      m0 += m;
      m1 += m * at.dv;
      m2 += m * (at.dv * at.dv);
    }
  };
  struct Moments {
    Vec one = zero(), t = zero(), v = zero(), tt = zero(), tv = zero(), vv = zero();
    void add(const PlanarPixels &p, const ChunkMoments &c) {
      const Vec m0_t = p.a_du * c.m0 + c.m1 * p.b, m1_t = p.a_du * c.m1 + c.m2 * p.b;
      one += c.m0;
      t += m0_t;
      v += c.m1;
      tt += p.a_du * m0_t + m1_t * p.b;
      tv += m1_t;
      vv += c.m2;
    }
    void finish(Vec *out) const {
      out[0] = one, out[1] = t, out[2] = v, out[3] = tt, out[4] = tv, out[5] = vv;
      for (int k = 6; k < 10; ++k) out[k] = zero();
    }
  };
};

// What both projective kinds share: q from (x, y) = L d and b = m.d, and its moments.
struct ProjectiveRow {
  Mask reached;
  Vec log2_alpha;
  Vec q, cx, cy;  // (q, x b / D, y b / D)
  Vec b_by_d;     // b / D

  ProjectiveRow(const Footprint &f, Vec x, Vec y, Vec b) {
    const Vec n = x * x + y * y;
    const Vec d = maximum(b * b + n * f.shape[9], splat(1e-30f));  // rays across the tangent plane have none
    const Vec inverse = 1.0f / d;
    q = n * inverse;
    b_by_d = b * inverse;
    cx = x * b_by_d;
    cy = y * b_by_d;
    log2_alpha = f.log2_opacity - q * kHalfLog2;
    reached = both(at_least(log2_alpha, splat(kLog2AlphaMin)), both(less(zero(), b), less(d * f.shape[10], b)));
  }
};

struct ProjectiveMoments9 {
  Vec m = zero(), c0 = zero(), c1 = zero(), c2 = zero();
  Vec c00 = zero(), c01 = zero(), c02 = zero(), c11 = zero(), c12 = zero(), c22 = zero();
  void add(const ProjectiveRow &at, Vec weight) {
    const Vec w0 = weight * at.q, w1 = weight * at.cx, w2 = weight * at.cy;
    m += weight;
    c0 += w0, c1 += w1, c2 += w2;
    c00 += w0 * at.q, c01 += w0 * at.cx, c02 += w0 * at.cy;
    c11 += w1 * at.cx, c12 += w1 * at.cy, c22 += w2 * at.cy;
  }
};

template <class Pixels>
struct ProjectiveTotals {
  ProjectiveMoments9 total;
  void add(const Pixels &, const ProjectiveMoments9 &c) {
    total.m += c.m;
    total.c0 += c.c0, total.c1 += c.c1, total.c2 += c.c2;
    total.c00 += c.c00, total.c01 += c.c01, total.c02 += c.c02;
    total.c11 += c.c11, total.c12 += c.c12, total.c22 += c.c22;
  }
  void finish(Vec *out) const {
    out[0] = total.m, out[1] = total.c0, out[2] = total.c1, out[3] = total.c2, out[4] = total.c00;
    out[5] = total.c01, out[6] = total.c02, out[7] = total.c11, out[8] = total.c12, out[9] = total.c22;
  }
};

// d = (cos(lat) sin(lon), sin(lat), cos(lat) cos(lon)).
struct PanoramaPixels {
  const Footprint &f;
  Vec x_level, y_level, b_level;  // the parts of L d and m.d that cos(lat) multiplies

  typedef ProjectiveRow Row;
  typedef ProjectiveMoments9 ChunkMoments;
  typedef ProjectiveTotals<PanoramaPixels> Moments;

  PanoramaPixels(const Footprint &footprint, const BlendArguments &args, int x0) : f(footprint) {
    const Vec sine = load(args.rays.column_sine + x0), cosine = load(args.rays.column_cosine + x0);
    x_level = sine * f.shape[0] + cosine * f.shape[2];
    y_level = sine * f.shape[3] + cosine * f.shape[5];
    b_level = sine * f.shape[6] + cosine * f.shape[8];
  }
  Row row(const BlendArguments &args, int y) const {
    const float sine = args.rays.row_sine[y], cosine = args.rays.row_cosine[y];
    return Row(f, x_level * cosine + sine * f.shape[1], y_level * cosine + sine * f.shape[4],
               b_level * cosine + sine * f.shape[7]);
  }
  void add_ray_gradient(const Footprint &, const Row &, Vec, float *, int, int) const {}
};

struct TablePixels {
  const Footprint &f;
  int x0;

  typedef ProjectiveRow Row;
  typedef ProjectiveMoments9 ChunkMoments;
  typedef ProjectiveTotals<TablePixels> Moments;

  TablePixels(const Footprint &footprint, const BlendArguments &, int x) : f(footprint), x0(x) {}
  static int64_t padded(int width) { return int64_t(width + kTile - 1) / kTile * kTile; }
  Row row(const BlendArguments &args, int y) const {
    const int64_t stride = padded(args.grid.width);
    const float *ray = args.rays.table + 3 * stride * y + x0;
    const Vec dx = load(ray), dy = load(ray + stride), dz = load(ray + 2 * stride);
    const float *s = f.shape;
    return Row(f, dx * s[0] + dy * s[1] + dz * s[2], dx * s[3] + dy * s[4] + dz * s[5], dx * s[6] + dy * s[7] + dz * s[8]);
  }
  // dq/dd = 2 (b / D) (c_x l0 + c_y l1 - q m), and M is worth -M/2 of dL/dq.
  void add_ray_gradient(const Footprint &g, const Row &at, Vec m, float *grad, int width, int y) const {
    const int64_t stride = padded(width);
    const Vec scale = -(m * at.b_by_d);
    const float *s = g.shape;
    float *out = grad + 3 * stride * y + x0;
    for (int axis = 0; axis < 3; ++axis) {
      const Vec step = at.cx * s[axis] + at.cy * s[3 + axis] - at.q * s[6 + axis];
      store(out + axis * stride, load(out + axis * stride) + scale * step);
    }
  }
};

}  // namespace PADGS_ISA
}  // namespace padgs
