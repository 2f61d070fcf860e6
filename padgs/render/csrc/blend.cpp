// Blending: one thread owns one tile at a time, one vector lane is one pixel of a chunk's row. Paper Eq. 4-5.
//
// Forward goes front to back, backward back to front, over the same list. Per instance the backward pass sums moments of
// M = dL/d(ln alpha) over the tile's pixels; planar.h and projective.h turn them into derivatives.
#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels.h"
#include "pixels.h"
#include "tiles.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

struct ForwardRow {
  Vec transmittance;  // negative once the pixel has stopped
  Vec red, green, blue, depth;
  Vec coverage;  // sum of weights: 1 - transmittance without the difference, which leaves few digits of a faint pixel
  VecI last;
};

void store_row(const BlendArguments &args, const Tile &tile, int chunk, int y, const ForwardRow &row) {
  const int x0 = tile.x0 + chunk * kTile, columns = std::min(kTile, args.grid.width - x0);
  const int64_t pixel = int64_t(tile.y0 + y) * args.grid.width + x0;
  const Vec t = maximum(row.transmittance, -row.transmittance);
  float lanes[5][kLanes];
  store(lanes[0], row.red + t * args.background[0]);
  store(lanes[1], row.green + t * args.background[1]);
  store(lanes[2], row.blue + t * args.background[2]);
  store(lanes[3], t);
  store(lanes[4], select(less(zero(), row.coverage), row.depth / row.coverage, zero()));
  int32_t last[kLanes];
  store_int(last, row.last);
  for (int x = 0; x < columns; ++x) {
    for (int channel = 0; channel < 3; ++channel) args.image[3 * (pixel + x) + channel] = lanes[channel][x];
    args.transmittance[pixel + x] = lanes[3][x];
    args.depth[pixel + x] = lanes[4][x];
    args.last[pixel + x] = last[x];
  }
}

template <class Pixels>
void forward_tile(const BlendArguments &args, const Tile &tile, int64_t index) {
  static thread_local std::vector<ForwardRow> storage;
  storage.resize(size_t(tile.chunks) * kTile);
  ForwardRow *rows = storage.data();
  uint32_t alive[1 << kMaxLevel];
  int alive_chunks = tile.chunks;
  for (int chunk = 0; chunk < tile.chunks; ++chunk) {
    alive[chunk] = (1u << tile.rows) - 1;
    const Vec inside = select(less(iota(), splat(float(tile.columns - chunk * kTile))), splat(1.0f), splat(-1.0f));
    for (int y = 0; y < tile.rows; ++y)
      rows[chunk * kTile + y] = {inside, zero(), zero(), zero(), zero(), zero(), zero_int()};
  }
  int64_t evaluated = 0, contributing = 0;

  for (int64_t i = tile.first; i < tile.end && alive_chunks; ++i) {
    prefetch(args, i + kAhead, tile.end);
    const Instance instance = args.instances[i];
    const Footprint &f = args.footprints[instance.gaussian];
    const VecI position = splat_int(int32_t(i - tile.first) + 1);
    for (int chunk = instance.chunk; chunk < instance.chunk_end; ++chunk) {
      const uint32_t wanted = alive[chunk] & ((1u << instance.row_end) - (1u << instance.row));
      if (!wanted) continue;
      const Pixels pixels(f, args, tile.x0 + chunk * kTile);
      evaluated += kTile * __builtin_popcount(wanted);
      for (uint32_t left = wanted; left; left &= left - 1) {
        const int y = __builtin_ctz(left);
        const typename Pixels::Row at = pixels.row(args, tile.y0 + y);
        if (!any(at.reached)) continue;
        ForwardRow &row = rows[chunk * kTile + y];
        const Vec alpha = minimum(exp2_fast(at.log2_alpha), splat(kAlphaMax));
        const Vec next = row.transmittance - row.transmittance * alpha;
        // A stopped pixel has a negative transmittance, so `next` never passes for it.
        const Mask drawn = both(at.reached, at_least(next, splat(kTransmittanceMin)));
        const Vec stopped = select(at.reached, minimum(row.transmittance, -row.transmittance), row.transmittance);
        if (!any(drawn)) {
          row.transmittance = stopped;
          if (any(at_least(stopped, zero()))) continue;
          alive[chunk] &= ~(1u << y);
          alive_chunks -= !alive[chunk];
          continue;
        }
        const Vec weight = keep(drawn, alpha * row.transmittance);
        row.red += weight * f.red;
        row.green += weight * f.green;
        row.blue += weight * f.blue;
        row.depth += weight * f.depth;
        row.coverage += weight;
        row.last = select_int(drawn, position, row.last);
        row.transmittance = select(drawn, next, stopped);
        contributing += count(drawn);
      }
    }
  }

  for (int chunk = 0; chunk < tile.chunks; ++chunk)
    for (int y = 0; y < tile.rows; ++y) store_row(args, tile, chunk, y, rows[chunk * kTile + y]);
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
int load_row(const BlendGradientArguments &args, const Tile &tile, int chunk, int y, BackwardRow &row) {
  const BlendArguments &forward = args.forward;
  const int x0 = tile.x0 + chunk * kTile, columns = std::min(kTile, forward.grid.width - x0);
  const int64_t pixel = int64_t(tile.y0 + y) * forward.grid.width + x0;
  float t[kLanes], behind[kLanes] = {}, grad[3][kLanes] = {}, grad_depth[kLanes] = {};
  int32_t last[kLanes] = {}, furthest = 0;
  std::fill_n(t, kLanes, 1.0f);
  for (int x = 0; x < columns; ++x) {
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

template <class Pixels, bool kWithDepth, bool kWithRays>
void backward_tile(const BlendGradientArguments &args, const Tile &tile) {
  const BlendArguments &forward = args.forward;
  static thread_local std::vector<BackwardRow> storage;
  storage.resize(size_t(tile.chunks) * kTile);
  BackwardRow *rows = storage.data();
  int furthest = 0;
  for (int chunk = 0; chunk < tile.chunks; ++chunk)
    for (int y = 0; y < tile.rows; ++y)
      furthest = std::max(furthest, load_row(args, tile, chunk, y, rows[chunk * kTile + y]));

  for (int64_t i = tile.first + furthest; i < tile.end; ++i)
    std::fill_n(args.moments + int64_t(forward.instances[i].slot) * kMoments, kMoments, 0.0f);
  for (int64_t i = tile.first + furthest - 1; i >= tile.first; --i) {
    if (i - kAhead >= tile.first) prefetch(forward, i - kAhead, tile.end);
    const Instance instance = forward.instances[i];
    const Footprint &f = forward.footprints[instance.gaussian];
    const VecI position = splat_int(int32_t(i - tile.first) + 1);
    typename Pixels::Moments moments;
    Vec red = zero(), green = zero(), blue = zero(), depth = zero();
    for (int chunk = instance.chunk; chunk < instance.chunk_end; ++chunk) {
      const Pixels pixels(f, forward, tile.x0 + chunk * kTile);
      typename Pixels::ChunkMoments in_chunk;
      for (int y = instance.row; y < instance.row_end; ++y) {
        BackwardRow &row = rows[chunk * kTile + y];
        const typename Pixels::Row at = pixels.row(forward, tile.y0 + y);
        const Mask drawn = both(at.reached, at_most(position, row.last));
        if (!any(drawn)) continue;
        const Vec full = exp2_fast(at.log2_alpha);
        const Vec alpha = keep(drawn, minimum(full, splat(kAlphaMax)));
        const Vec inverse = 1.0f / (1.0f - alpha);
        row.transmittance = row.transmittance * inverse;
        const Vec weight = alpha * row.transmittance;
        Vec signal = row.grad_red * f.red + row.grad_green * f.green + row.grad_blue * f.blue;
        if (kWithDepth) signal += row.grad_depth * f.depth;
        signal = signal * weight;
        // alpha dL/dalpha = T alpha (c . G) - (what is behind) alpha / (1 - alpha), and 0 where alpha is limited.
        const Vec m = keep(less(full, splat(kAlphaMax)), signal - row.behind * (inverse * alpha));
        row.behind += signal;
        red += weight * row.grad_red;
        green += weight * row.grad_green;
        blue += weight * row.grad_blue;
        if (kWithDepth) depth += weight * row.grad_depth;
        in_chunk.add(at, m);
        if (kWithRays) pixels.add_ray_gradient(f, at, m, args.grad_rays, forward.grid.width, tile.y0 + y);
      }
      moments.add(pixels, in_chunk);
    }
    float *out = args.moments + int64_t(instance.slot) * kMoments;
    Vec sums[kMoments];
    moments.finish(sums);
    sums[10] = red, sums[11] = green, sums[12] = blue, sums[13] = depth;
    sums[14] = sums[15] = zero();
    for (int k = 0; k < kMoments; k += 4) sum4(sums + k, out + k);
  }
}

template <class Pixels>
void backward_all(const BlendGradientArguments &args) {
  for_each_tile(args.forward, [&](const Tile &tile, int64_t) {
    if (args.grad_rays)
      backward_tile<Pixels, true, true>(args, tile);
    else if (args.grad_depth)
      backward_tile<Pixels, true, false>(args, tile);
    else
      backward_tile<Pixels, false, false>(args, tile);
  });
}

template <class Pixels>
void forward_all(const BlendArguments &args) {
  for_each_tile(args, [&](const Tile &tile, int64_t index) { forward_tile<Pixels>(args, tile, index); });
}

bool planar(const BlendArguments &args) { return args.projection == kErp || args.projection == kPinhole; }

void blend_forward(const BlendArguments &args) {
  if (planar(args))
    forward_all<PlanarPixels>(args);
  else if (args.rays.table)
    forward_all<TablePixels>(args);
  else
    forward_all<PanoramaPixels>(args);
}

void blend_backward(const BlendGradientArguments &args) {
  if (planar(args.forward))
    backward_all<PlanarPixels>(args);
  else if (args.forward.rays.table)
    backward_all<TablePixels>(args);
  else
    backward_all<PanoramaPixels>(args);
}

}  // namespace

extern const BlendKernels blend_kernels;
const BlendKernels blend_kernels = {blend_forward, blend_backward};

}  // namespace PADGS_ISA
}  // namespace padgs
