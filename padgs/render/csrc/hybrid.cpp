// Hybrid blending: each pixel keeps its K nearest fragments in order and blends the rest as one layer behind them. The
// definition is padgs/render/hybrid.py. Nothing is sorted before; the tile lists may be in any order.
//
// A chunk of 16 x 16 pixels is finished before the next, so that its fragments stay in the cache. The backward pass
// collects the fragments again, turns every slot into what its derivative needs, and visits the list a second time.
#include <cmath>
#include <vector>

#include "fragments.h"
#include "kernels.h"
#include "pixels.h"
#include "tiles.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

// Sixteen rows of sixteen pixels.
struct Chunk {
  int index, x0, columns;
  Mask inside;  // the image
  Fragments *rows;

  Chunk(const BlendArguments &args, const Tile &tile, int i) : index(i), x0(tile.x0 + i * kTile) {
    static thread_local std::vector<Slot> slots;
    static thread_local std::vector<Fragments> storage;
    columns = std::min(kTile, args.grid.width - x0);
    inside = less(iota(), splat(float(columns)));
    const int size = int(std::min<int64_t>(args.core_size, std::max<int64_t>(tile.end - tile.first, 1)));
    if (slots.size() < size_t(kTile) * size) slots.resize(size_t(kTile) * size);
    storage.clear();
    for (int y = 0; y < kTile; ++y) storage.push_back({slots.data() + y * size, size, 0, Tail()});
    rows = storage.data();
  }
  bool reached_by(const Instance &instance) const { return instance.chunk <= index && index < instance.chunk_end; }
  int64_t pixel(const BlendArguments &args, const Tile &tile, int y) const {
    return int64_t(tile.y0 + y) * args.grid.width + x0;
  }
};

// Where a Gaussian lies on the rays: for `ray` at its largest value there, |M^-1 mean| b / D; else at its mean.
float ray_reach(const BlendArguments &args, const Footprint &f) {
  return args.projection == kRay ? 1.0f / std::sqrt(f.shape[9]) : 0.0f;
}
Vec distance(const ProjectiveRow &at, const Footprint &f, float reach) {
  return reach > 0 ? at.b_by_d * reach : splat(f.depth);
}
Vec distance(const PlanarPixels::Row &, const Footprint &f, float) { return splat(f.depth); }

// Brings all fragments of a chunk together; returns how many pairs were evaluated.
template <class Pixels>
int64_t collect(const BlendArguments &args, const Tile &tile, const Chunk &chunk) {
  int64_t evaluated = 0;
  for (int64_t i = tile.first; i < tile.end; ++i) {
    prefetch(args, i + kAhead, tile.end);
    const Instance instance = args.instances[i];
    if (!chunk.reached_by(instance)) continue;
    const Footprint &f = args.footprints[instance.gaussian];
    const Pixels pixels(f, args, chunk.x0);
    const float reach = ray_reach(args, f);
    for (int y = instance.row; y < instance.row_end; ++y) {
      const typename Pixels::Row at = pixels.row(args, tile.y0 + y);
      const Mask reached = both(at.reached, chunk.inside);
      if (!any(reached)) continue;
      const Vec alpha = keep(reached, minimum(exp2_fast(at.log2_alpha), splat(kAlphaMax)));
      chunk.rows[y].add(args.footprints, instance.gaussian, distance(at, f, reach), alpha);
    }
    evaluated += kTile * (instance.row_end - instance.row);
  }
  return evaluated;
}

// What a core fragment leaves of `left`; nothing once that is below the threshold.
Vec left_behind(Vec left, Vec weight) {
  const Vec next = left - weight;
  return keep(at_least(next, splat(kTransmittanceMin)), next);
}

// (1 - left) / (sum of alpha): the opacity of the tail's layer, for each unit of alpha in it.
Vec opacity_per_alpha(const Tail &tail) {
  const Mask some = less(zero(), tail.alpha);
  return keep(some, (1.0f - tail.left) / select(some, tail.alpha, splat(1.0f)));
}

int64_t blend_row(const BlendArguments &args, const Tile &tile, const Chunk &chunk, int y) {
  const Fragments &row = chunk.rows[y];
  const Tail &tail = row.tail;
  Vec left = splat(1.0f), red = zero(), green = zero(), blue = zero(), depth = zero(), coverage = zero();
  int64_t contributing = 0;
  for (int k = 0; k < row.filled; ++k) {
    const Vec weight = row.core[k].alpha * left;
    const Colors c = gather(args.footprints, row.core[k].gaussian);
    red += weight * c.red;
    green += weight * c.green;
    blue += weight * c.blue;
    depth += weight * c.depth;
    coverage += weight;
    contributing += count(less(zero(), weight));
    left = left_behind(left, weight);
  }
  const Vec share = left * opacity_per_alpha(tail);
  const Vec transmittance = left * tail.left;
  coverage += share * tail.alpha;
  contributing += int64_t(sum(keep(less(zero(), left), tail.count)));
  float lanes[5][kLanes];
  store(lanes[0], red + share * tail.red + transmittance * args.background[0]);
  store(lanes[1], green + share * tail.green + transmittance * args.background[1]);
  store(lanes[2], blue + share * tail.blue + transmittance * args.background[2]);
  store(lanes[3], transmittance);
  store(lanes[4], select(less(zero(), coverage), (depth + share * tail.depth) / coverage, zero()));
  const int64_t pixel = chunk.pixel(args, tile, y);
  for (int x = 0; x < chunk.columns; ++x) {
    for (int channel = 0; channel < 3; ++channel) args.image[3 * (pixel + x) + channel] = lanes[channel][x];
    args.transmittance[pixel + x] = lanes[3][x];
    args.depth[pixel + x] = lanes[4][x];
  }
  return contributing;
}

template <class Pixels>
void forward_all(const BlendArguments &args) {
  for_each_tile(args, [&](const Tile &tile, int64_t index) {
    int64_t evaluated = 0, contributing = 0;
    for (int i = 0; i < tile.chunks; ++i) {
      const Chunk chunk(args, tile, i);
      evaluated += collect<Pixels>(args, tile, chunk);
      for (int y = 0; y < tile.rows; ++y) contributing += blend_row(args, tile, chunk, y);
    }
    args.pair_counts[2 * index] = evaluated;
    args.pair_counts[2 * index + 1] = contributing;
  });
}

// Upstream gradients of a row of pixels, and what the derivatives of its tail fragments need. With s the signal of a
// fragment (upstream gradient of its colour and depth times these), a fragment of weight alpha u has
//   dL/dalpha = u (s - mean) - behind / (1 - alpha),
// in the core u = what is in front leaves, mean = 0, behind = weighted signals behind it, background included;
// in the tail u = T (1 - Q) / Z, mean = mean signal of the tail, behind = T Q (signal of the background - mean).
struct Upstream {
  Vec red, green, blue, depth, offset;
  Vec unit, mean, behind;  // of the tail
  Vec furthest;            // distance at which the core ends

  Vec signal(Vec r, Vec g, Vec b, Vec d) const { return red * r + green * g + blue * b + depth * d + offset; }
};

// Loads a row and replaces distance and alpha of its slots by u and behind.
Upstream differentiate_row(const BlendGradientArguments &args, const Tile &tile, const Chunk &chunk, int y) {
  const BlendArguments &forward = args.forward;
  Fragments &row = chunk.rows[y];
  const Tail &tail = row.tail;
  float grad[3][kLanes] = {}, through[kLanes] = {}, depth[kLanes] = {}, grad_depth[kLanes] = {};
  const int64_t pixel = chunk.pixel(forward, tile, y);
  for (int x = 0; x < chunk.columns; ++x) {
    const int64_t p = pixel + x;
    if (args.grad_transmittance) through[x] = args.grad_transmittance[p];
    for (int channel = 0; channel < 3; ++channel) {
      grad[channel][x] = args.grad_image[3 * p + channel];
      through[x] += grad[channel][x] * forward.background[channel];
    }
    if (args.grad_depth) depth[x] = forward.depth[p], grad_depth[x] = args.grad_depth[p];
  }
  Upstream up;
  up.furthest = row.filled == row.size ? row.core[row.size - 1].distance : splat(kEmpty);
  Vec left = splat(1.0f), coverage = zero();
  for (int k = 0; k < row.filled; ++k) {
    const Vec weight = row.core[k].alpha * left;
    row.core[k].distance = left;
    coverage += weight;
    left = left_behind(left, weight);
  }
  up.red = load(grad[0]), up.green = load(grad[1]), up.blue = load(grad[2]);
  up.unit = left * opacity_per_alpha(tail);
  coverage += up.unit * tail.alpha;
  // depth = sum(w z) / sum(w): its derivative by w is (z - depth) / sum(w).
  up.depth = keep(less(zero(), coverage), load(grad_depth) / select(less(zero(), coverage), coverage, splat(1.0f)));
  up.offset = -(up.depth * load(depth));
  const Mask some = less(zero(), tail.alpha);
  const Vec each = 1.0f / select(some, tail.alpha, splat(1.0f));
  up.mean = keep(some, up.signal(tail.red * each, tail.green * each, tail.blue * each, tail.depth * each));
  up.behind = left * tail.left * (load(through) - up.mean);
  Vec behind = up.unit * tail.alpha * up.mean + left * tail.left * load(through);
  for (int k = row.filled - 1; k >= 0; --k) {
    Slot &slot = row.core[k];
    const Colors c = gather(forward.footprints, slot.gaussian);
    const Vec here = slot.alpha * slot.distance * up.signal(c.red, c.green, c.blue, c.depth);
    slot.alpha = behind;
    behind += here;
  }
  return up;
}

// The moments of every instance over the pixels of one chunk, added to those of the chunks before.
template <class Pixels>
void add_moments(const BlendGradientArguments &args, const Tile &tile, const Chunk &chunk, const Upstream *upstream) {
  const BlendArguments &forward = args.forward;
  for (int64_t i = tile.first; i < tile.end; ++i) {
    prefetch(forward, i + kAhead, tile.end);
    const Instance instance = forward.instances[i];
    if (!chunk.reached_by(instance)) continue;
    const Footprint &f = forward.footprints[instance.gaussian];
    const Pixels pixels(f, forward, chunk.x0);
    const VecI gaussian = splat_int(instance.gaussian);
    const float reach = ray_reach(forward, f);
    const Vec f_red = splat(f.red), f_green = splat(f.green), f_blue = splat(f.blue), f_depth = splat(f.depth);
    typename Pixels::ChunkMoments in_chunk;
    Vec red = zero(), green = zero(), blue = zero(), depth = zero();
    for (int y = instance.row; y < instance.row_end; ++y) {
      const typename Pixels::Row at = pixels.row(forward, tile.y0 + y);
      const Mask reached = both(at.reached, chunk.inside);
      if (!any(reached)) continue;
      const Vec full = exp2_fast(at.log2_alpha);
      const Vec alpha = keep(reached, minimum(full, splat(kAlphaMax)));
      const Upstream &up = upstream[y];
      const Fragments &row = chunk.rows[y];
      Vec unit = up.unit, mean = up.mean, behind = up.behind;
      // The margins are for rounding, which may differ from that of `collect`; what is not found is in the tail.
      const Mask near = at_least(up.furthest * 1.001f, distance(at, f, reach));
      Mask sought = both(near, at_least(alpha, splat(kCoreAlphaMin * 0.999f)));
      for (int k = 0; k < row.filled && any(sought); ++k) {
        const Mask found = both(sought, equal(row.core[k].gaussian, gaussian));
        unit = select(found, row.core[k].distance, unit);
        mean = select(found, zero(), mean);
        behind = select(found, row.core[k].alpha, behind);
        sought = without(sought, found);
      }
      const Vec weight = alpha * unit;
      const Vec signal = up.signal(f_red, f_green, f_blue, f_depth) - mean;
      const Vec m = keep(less(full, splat(kAlphaMax)), weight * signal - behind * (alpha / (1.0f - alpha)));
      red += weight * up.red;
      green += weight * up.green;
      blue += weight * up.blue;
      depth += weight * up.depth;
      in_chunk.add(at, m);
      if (args.grad_rays) pixels.add_ray_gradient(f, at, m, args.grad_rays, forward.grid.width, tile.y0 + y);
    }
    typename Pixels::Moments moments;
    moments.add(pixels, in_chunk);
    Vec sums[kMoments];
    moments.finish(sums);
    sums[10] = red, sums[11] = green, sums[12] = blue, sums[13] = depth;
    sums[14] = sums[15] = zero();
    float totals[kMoments];
    for (int k = 0; k < kMoments; k += 4) sum4(sums + k, totals + k);
    float *out = args.moments + int64_t(instance.slot) * kMoments;
    const bool first = chunk.index == instance.chunk;
    for (int k = 0; k < kMoments; ++k) out[k] = first ? totals[k] : out[k] + totals[k];
  }
}

template <class Pixels>
void backward_all(const BlendGradientArguments &args) {
  for_each_tile(args.forward, [&](const Tile &tile, int64_t) {
    Upstream upstream[kTile];
    for (int i = 0; i < tile.chunks; ++i) {
      const Chunk chunk(args.forward, tile, i);
      collect<Pixels>(args.forward, tile, chunk);
      for (int y = 0; y < tile.rows; ++y) upstream[y] = differentiate_row(args, tile, chunk, y);
      add_moments<Pixels>(args, tile, chunk, upstream);
    }
  });
}

bool planar(const BlendArguments &args) { return args.projection == kErp || args.projection == kPinhole; }

void hybrid_forward(const BlendArguments &args) {
  if (planar(args))
    forward_all<PlanarPixels>(args);
  else if (args.rays.table)
    forward_all<TablePixels>(args);
  else
    forward_all<PanoramaPixels>(args);
}

void hybrid_backward(const BlendGradientArguments &args) {
  if (planar(args.forward))
    backward_all<PlanarPixels>(args);
  else if (args.forward.rays.table)
    backward_all<TablePixels>(args);
  else
    backward_all<PanoramaPixels>(args);
}

}  // namespace

extern const BlendKernels hybrid_kernels;
const BlendKernels hybrid_kernels = {hybrid_forward, hybrid_backward};

}  // namespace PADGS_ISA
}  // namespace padgs
