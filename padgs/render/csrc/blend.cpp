// Blending: one thread owns one tile at a time, one vector lane is one pixel of a tile row. Paper Eq. 4-5.
//
// Forward goes front to back, backward back to front, over the same list. Per instance the backward pass sums moments of
// M = dL/d(ln alpha) over the tile's pixels; because du does not depend on the row, three vector sums over the rows
// (M, dv M, dv^2 M) give all six moments at the end.
#include <algorithm>
#include <cmath>

#include "kernels.h"
#include "simd.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

const float kLog2AlphaMin = -std::log2(255.0f);

// One tile's place in the image.
struct Tile {
  int x0, y0, columns, rows;
  int64_t first, end;  // its instances
};

Tile tile_at(const BlendArguments &args, int64_t index) {
  int per_row = (args.width + kTile - 1) / kTile;
  int x0 = int(index % per_row) * kTile, y0 = (args.first_tile_row + int(index / per_row)) * kTile;
  return {x0, y0, std::min(kTile, args.width - x0), std::min(kTile, args.height - y0), args.tile_start[index],
          args.tile_start[index + 1]};
}

// One Gaussian's exponent along the rows of a tile.
struct Evaluator {
  Vec du, a_du;
  float v, b, c, log2_opacity;
  int row, row_end;

  Evaluator(const Footprint &f, const Tile &tile, const BlendArguments &args)
      : v(f.v - 0.5f - float(tile.y0)), b(f.b), c(f.c), log2_opacity(f.log2_opacity) {
    Vec offset = iota() + (float(tile.x0) + 0.5f - f.u);
    // With wrap, the nearest copy of the Gaussian across the seam.
    const float width = float(args.width), turns = args.wrap ? 1.0f / width : 0.0f;
    du = offset - round_down(offset * turns + 0.5f) * width;
    a_du = du * f.a;
    row = std::max(0, int(std::ceil(std::max(v - f.row_reach, -1.0f))));
    row_end = std::min(tile.rows, int(std::floor(std::min(v + f.row_reach, float(kTile)))) + 1);
  }
  float dv(int y) const { return float(y) - v; }
  Vec log2_alpha(int y) const {
    float d = dv(y);
    Vec t = a_du + b * d;
    return (log2_opacity - (c * d) * (c * d)) - t * t;
  }
};

struct ForwardRow {
  Vec transmittance = zero();  // negative once the pixel has stopped
  Vec red = zero(), green = zero(), blue = zero(), depth = zero();
  VecI last = zero_int();
};

void store_row(const BlendArguments &args, const Tile &tile, int y, const ForwardRow &row) {
  const int64_t pixel = int64_t(tile.y0 + y) * args.width + tile.x0;
  const Vec t = maximum(row.transmittance, -row.transmittance), coverage = 1.0f - t;
  float lanes[6][kLanes];
  store(lanes[0], row.red + t * args.background[0]);
  store(lanes[1], row.green + t * args.background[1]);
  store(lanes[2], row.blue + t * args.background[2]);
  store(lanes[3], t);
  store(lanes[4], select(less(zero(), coverage), row.depth / coverage, zero()));
  int32_t last[kLanes];
  store_int(last, row.last);
  for (int x = 0; x < tile.columns; ++x) {
    for (int channel = 0; channel < 3; ++channel) args.image[3 * (pixel + x) + channel] = lanes[channel][x];
    args.transmittance[pixel + x] = lanes[3][x];
    args.depth[pixel + x] = lanes[4][x];
    args.last[pixel + x] = last[x];
  }
}

void forward_tile(const BlendArguments &args, int64_t index) {
  const Tile tile = tile_at(args, index);
  ForwardRow rows[kTile];
  uint32_t alive = (1u << tile.rows) - 1;
  const Vec inside = select(less(iota(), splat(float(tile.columns))), splat(1.0f), splat(-1.0f));
  for (int y = 0; y < tile.rows; ++y) rows[y].transmittance = inside;
  int64_t evaluated = 0, contributing = 0;

  for (int64_t i = tile.first; i < tile.end && alive; ++i) {
    const Footprint &f = args.footprints[args.instances[i]];
    const Evaluator at(f, tile, args);
    for (int y = at.row; y < at.row_end; ++y) {
      if (!(alive >> y & 1)) continue;
      const Vec exponent = at.log2_alpha(y);
      const Mask reached = at_least(exponent, splat(kLog2AlphaMin));
      evaluated += kTile;
      if (!any(reached)) continue;
      ForwardRow &row = rows[y];
      const Vec alpha = minimum(exp2_fast(exponent), splat(kAlphaMax));
      const Vec next = row.transmittance * (1.0f - alpha);
      const Mask running = both(reached, at_least(row.transmittance, zero()));
      const Mask drawn = both(running, at_least(next, splat(kTransmittanceMin)));
      const Mask stopped = without(running, drawn);
      const Vec weight = keep(drawn, alpha * row.transmittance);
      row.red += weight * f.red;
      row.green += weight * f.green;
      row.blue += weight * f.blue;
      row.depth += weight * f.depth;
      row.transmittance = select(drawn, next, row.transmittance);
      row.last = select_int(drawn, splat_int(int32_t(i - tile.first) + 1), row.last);
      contributing += count(drawn);
      if (any(stopped)) {
        row.transmittance = select(stopped, -row.transmittance, row.transmittance);
        if (!any(at_least(row.transmittance, zero()))) alive &= ~(1u << y);
      }
    }
  }

  for (int y = 0; y < tile.rows; ++y) store_row(args, tile, y, rows[y]);
  args.pair_counts[2 * index] = evaluated;
  args.pair_counts[2 * index + 1] = contributing;
}

struct BackwardRow {
  Vec transmittance;  // in front of the Gaussian being visited
  Vec behind;         // sum of weight * (dL/dcolour . colour) behind it, background included
  Vec grad_red, grad_green, grad_blue, grad_depth;
  VecI last;
};

// Loads one row of upstream gradients; returns the largest `last` of its pixels.
int load_row(const BlendGradientArguments &args, const Tile &tile, int y, BackwardRow &row) {
  const BlendArguments &forward = args.forward;
  const int64_t pixel = int64_t(tile.y0 + y) * forward.width + tile.x0;
  float t[kLanes], behind[kLanes] = {}, grad[3][kLanes] = {}, grad_depth[kLanes] = {};
  int32_t last[kLanes] = {}, furthest = 0;
  std::fill_n(t, kLanes, 1.0f);
  for (int x = 0; x < tile.columns; ++x) {
    const int64_t p = pixel + x;
    t[x] = forward.transmittance[p];
    float grad_t = args.grad_transmittance ? args.grad_transmittance[p] : 0.0f;
    for (int channel = 0; channel < 3; ++channel) {
      grad[channel][x] = args.grad_image[3 * p + channel];
      grad_t += grad[channel][x] * forward.background[channel];
    }
    if (args.grad_depth && t[x] < 1) {  // depth = sum(w r) / (1 - T)
      grad_depth[x] = args.grad_depth[p] / (1.0f - t[x]);
      grad_t += grad_depth[x] * forward.depth[p];
    }
    behind[x] = t[x] * grad_t;
    last[x] = forward.last[p];
    furthest = std::max(furthest, last[x]);
  }
  row = {load(t), load(behind), load(grad[0]), load(grad[1]), load(grad[2]), load(grad_depth), load_int(last)};
  return furthest;
}

template <bool kWithDepth>
void backward_tile(const BlendGradientArguments &args, int64_t index) {
  const BlendArguments &forward = args.forward;
  const Tile tile = tile_at(forward, index);
  BackwardRow rows[kTile];
  int furthest = 0;
  for (int y = 0; y < tile.rows; ++y) furthest = std::max(furthest, load_row(args, tile, y, rows[y]));

  for (int64_t i = tile.first + furthest; i < tile.end; ++i)
    std::fill_n(args.moments + forward.slots[i] * kMoments, kMoments, 0.0f);
  for (int64_t i = tile.first + furthest - 1; i >= tile.first; --i) {
    const Footprint &f = forward.footprints[forward.instances[i]];
    const Evaluator at(f, tile, forward);
    const VecI position = splat_int(int32_t(i - tile.first) + 1);
    Vec m0 = zero(), m1 = zero(), m2 = zero(), red = zero(), green = zero(), blue = zero(), depth = zero();
    for (int y = at.row; y < at.row_end; ++y) {
      const Vec exponent = at.log2_alpha(y);
      BackwardRow &row = rows[y];
      const Mask drawn = both(at_least(exponent, splat(kLog2AlphaMin)), at_most(position, row.last));
      if (!any(drawn)) continue;
      const Vec full = exp2_fast(exponent);
      const Vec alpha = keep(drawn, minimum(full, splat(kAlphaMax)));
      const Vec inverse = 1.0f / (1.0f - alpha);
      const Vec transmittance = row.transmittance * inverse;
      const Vec weight = alpha * transmittance;
      Vec signal = row.grad_red * f.red + row.grad_green * f.green + row.grad_blue * f.blue;
      if (kWithDepth) signal += row.grad_depth * f.depth;
      // dL/dalpha = T (c . G) - (what is behind) / (1 - alpha); alpha dL/dalpha, and 0 where alpha is limited.
      Vec m = weight * signal - row.behind * (inverse * alpha);
      m = select(less(full, splat(kAlphaMax)), m, zero());
      row.behind += weight * signal;
      row.transmittance = transmittance;
      red += weight * row.grad_red;
      green += weight * row.grad_green;
      blue += weight * row.grad_blue;
      if (kWithDepth) depth += weight * row.grad_depth;
      const float dv = at.dv(y);
      m0 += m;
      m1 += m * dv;
      m2 += m * (dv * dv);
    }
    float *out = args.moments + forward.slots[i] * kMoments;
    out[0] = sum(m0);
    out[1] = sum(m0 * at.du);
    out[2] = sum(m1);
    out[3] = sum(m0 * at.du * at.du);
    out[4] = sum(m1 * at.du);
    out[5] = sum(m2);
    out[6] = sum(red);
    out[7] = sum(green);
    out[8] = sum(blue);
    out[9] = kWithDepth ? sum(depth) : 0.0f;
  }
}

int64_t tile_count(const BlendArguments &args) {
  return int64_t(args.end_tile_row - args.first_tile_row) * ((args.width + kTile - 1) / kTile);
}

void blend_forward(const BlendArguments &args) {
  const int64_t tiles = tile_count(args);
#pragma omp parallel for schedule(dynamic, 1)
  for (int64_t index = 0; index < tiles; ++index) forward_tile(args, index);
}

void blend_backward(const BlendGradientArguments &args) {
  const int64_t tiles = tile_count(args.forward);
#pragma omp parallel for schedule(dynamic, 1)
  for (int64_t index = 0; index < tiles; ++index) {
    if (args.grad_depth)
      backward_tile<true>(args, index);
    else
      backward_tile<false>(args, index);
  }
}

}  // namespace

extern const BlendKernels blend_kernels;
const BlendKernels blend_kernels = {blend_forward, blend_backward};

}  // namespace PADGS_ISA
}  // namespace padgs
