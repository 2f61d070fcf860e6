// Hybrid blending: each pixel keeps its K nearest fragments in order and blends the rest as one layer behind them. The
// definition is padgs/render/hybrid.py. Nothing is sorted before; the tile lists may be in any order.
//
// A column of patches, 8 x 16 pixels, is finished before the next, so that its fragments stay in the cache. The backward pass
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

constexpr int kPatchesInColumn = kTile / kPatchHeight;

// A column of patches of a tile, and their fragments.
struct PatchColumn {
  int index;
  const Tile &tile;
  const BlendArguments &args;
  Fragments *fragments;  // [patch rows]

  PatchColumn(const BlendArguments &args, const Tile &tile, int index) : index(index), tile(tile), args(args) {
    static thread_local std::vector<Slot> slots;
    static thread_local std::vector<Fragments> storage;
    const int size = int(std::min<int64_t>(args.core_size, std::max<int64_t>(tile.end - tile.first, 1)));
    if (slots.size() < size_t(kPatchesInColumn) * size) slots.resize(size_t(kPatchesInColumn) * size);
    storage.clear();
    for (int row = 0; row < tile.patch_rows; ++row) storage.push_back({slots.data() + row * size, size, 0, Tail()});
    fragments = storage.data();
  }
  bool reached_by(const Instance &instance) const { return instance.column <= index && index < instance.column_end; }
  int number(int row) const { return row * tile.patch_columns + index; }  // of a patch in the tile
  Patch patch(int row) const { return Patch(tile, number(row), args.grid.width); }
};

// Where a Gaussian lies on the rays: for `ray` at its largest value there, |M^-1 mean| b / D; else at its mean.
float ray_reach(const BlendArguments &args, const Footprint &f) {
  return args.projection == kRay ? 1.0f / std::sqrt(f.shape[9]) : 0.0f;
}
Vec distance(const ProjectiveFootprint::At &at, const Footprint &f, float reach) {
  return reach > 0 ? at.b_by_d * reach : splat(f.depth);
}
Vec distance(const PlanarFootprint::At &, const Footprint &f, float) { return splat(f.depth); }

template <class Seen>
using Places = std::vector<typename Seen::Place>;

// Brings all fragments of a column together; returns how many pairs were evaluated.
template <class Seen>
int64_t collect(const PatchColumn &column, const Places<Seen> &places) {
  const BlendArguments &args = column.args;
  const Tile &tile = column.tile;
  Vec inside[kPatchesInColumn];
  for (int row = 0; row < tile.patch_rows; ++row) inside[row] = column.patch(row).inside();
  int64_t evaluated = 0;
  for (int64_t i = tile.first; i < tile.end; ++i) {
    prefetch(args, i + kAhead, tile.end);
    const Instance instance = args.instances[i];
    if (!column.reached_by(instance)) continue;
    const Footprint &f = args.footprints[instance.gaussian];
    const Seen g(f, args, tile);
    const float reach = ray_reach(args, f);
    for (int row = instance.row; row < instance.row_end; ++row) {
      const typename Seen::At at = g.at(places[column.number(row)]);
      const Mask reached = both(at.reached, less(zero(), inside[row]));
      if (!any(reached)) continue;
      const Vec alpha = keep(reached, minimum(exp2_fast(at.log2_alpha), splat(kAlphaMax)));
      column.fragments[row].add(args.footprints, instance.gaussian, distance(at, f, reach), alpha);
    }
    evaluated += kLanes * (instance.row_end - instance.row);
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

int64_t blend_patch(const PatchColumn &column, int row) {
  const BlendArguments &args = column.args;
  const Fragments &fragments = column.fragments[row];
  const Tail &tail = fragments.tail;
  Vec left = splat(1.0f), red = zero(), green = zero(), blue = zero(), depth = zero(), coverage = zero();
  int64_t contributing = 0;
  for (int k = 0; k < fragments.filled; ++k) {
    const Vec weight = fragments.core[k].alpha * left;
    const Colors c = gather(args.footprints, fragments.core[k].gaussian);
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
  column.patch(row).each_pixel([&](int lane, int64_t pixel) {
    for (int channel = 0; channel < 3; ++channel) args.image[3 * pixel + channel] = lanes[channel][lane];
    args.transmittance[pixel] = lanes[3][lane];
    args.depth[pixel] = lanes[4][lane];
  });
  return contributing;
}

template <class Seen>
void forward_tile(const BlendArguments &args, const Tile &tile, int64_t index) {
  const Places<Seen> &places = places_of<Seen>(args, tile);
  int64_t evaluated = 0, contributing = 0;
  for (int i = 0; i < tile.patch_columns; ++i) {
    const PatchColumn column(args, tile, i);
    evaluated += collect<Seen>(column, places);
    for (int row = 0; row < tile.patch_rows; ++row) contributing += blend_patch(column, row);
  }
  args.pair_counts[2 * index] = evaluated;
  args.pair_counts[2 * index + 1] = contributing;
}

// Upstream gradients of a patch, and what the derivatives of its tail fragments need. With s the signal of a
// fragment (upstream gradient of its colour and depth times these), a fragment of weight alpha u has
//   dL/dalpha = u (s - mean) - behind / (1 - alpha),
// in the core u = what is in front leaves, mean = 0, behind = weighted signals behind it, background included;
// in the tail u = T (1 - Q) / Z, mean = mean signal of the tail, behind = T Q (signal of the background - mean).
struct Upstream {
  Vec red, green, blue, depth, offset;
  Vec unit, mean, behind;  // of the tail
  Vec furthest;            // distance at which the core ends
  Vec inside;              // 1 inside the image, -1 outside

  Vec signal(Vec r, Vec g, Vec b, Vec d) const { return red * r + green * g + blue * b + depth * d + offset; }
};

// Loads a patch and replaces distance and alpha of its slots by u and behind.
Upstream differentiate_patch(const BlendGradientArguments &args, const PatchColumn &column, int row) {
  const BlendArguments &forward = args.forward;
  Fragments &fragments = column.fragments[row];
  const Tail &tail = fragments.tail;
  float grad[3][kLanes] = {}, through[kLanes] = {}, depth[kLanes] = {}, grad_depth[kLanes] = {};
  column.patch(row).each_pixel([&](int lane, int64_t pixel) {
    if (args.grad_transmittance) through[lane] = args.grad_transmittance[pixel];
    for (int channel = 0; channel < 3; ++channel) {
      grad[channel][lane] = args.grad_image[3 * pixel + channel];
      through[lane] += grad[channel][lane] * forward.background[channel];
    }
    if (args.grad_depth) depth[lane] = forward.depth[pixel], grad_depth[lane] = args.grad_depth[pixel];
  });
  Upstream up;
  up.inside = column.patch(row).inside();
  up.furthest = fragments.filled == fragments.size ? fragments.core[fragments.size - 1].distance : splat(kEmpty);
  Vec left = splat(1.0f), coverage = zero();
  for (int k = 0; k < fragments.filled; ++k) {
    const Vec weight = fragments.core[k].alpha * left;
    fragments.core[k].distance = left;
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
  for (int k = fragments.filled - 1; k >= 0; --k) {
    Slot &slot = fragments.core[k];
    const Colors c = gather(forward.footprints, slot.gaussian);
    const Vec here = slot.alpha * slot.distance * up.signal(c.red, c.green, c.blue, c.depth);
    slot.alpha = behind;
    behind += here;
  }
  return up;
}

// The moments of every instance over the patches of one column, added to those of the columns before.
template <class Seen>
void add_moments(const BlendGradientArguments &args, const PatchColumn &column, const Upstream *upstream,
                 const Places<Seen> &places, Places<Seen> &ray_gradients) {
  const BlendArguments &forward = args.forward;
  const Tile &tile = column.tile;
  for (int64_t i = tile.first; i < tile.end; ++i) {
    prefetch(forward, i + kAhead, tile.end);
    const Instance instance = forward.instances[i];
    if (!column.reached_by(instance)) continue;
    const Footprint &f = forward.footprints[instance.gaussian];
    const Seen g(f, forward, tile);
    const VecI gaussian = splat_int(instance.gaussian);
    const float reach = ray_reach(forward, f);
    const Vec f_red = splat(f.red), f_green = splat(f.green), f_blue = splat(f.blue), f_depth = splat(f.depth);
    typename Seen::Moments moments;
    Vec red = zero(), green = zero(), blue = zero(), depth = zero();
    for (int row = instance.row; row < instance.row_end; ++row) {
      const typename Seen::At at = g.at(places[column.number(row)]);
      const Upstream &up = upstream[row];
      const Mask reached = both(at.reached, less(zero(), up.inside));
      if (!any(reached)) continue;
      const Vec full = exp2_fast(at.log2_alpha);
      const Vec alpha = keep(reached, minimum(full, splat(kAlphaMax)));
      const Fragments &fragments = column.fragments[row];
      Vec unit = up.unit, mean = up.mean, behind = up.behind;
      // The margins are for rounding, which may differ from that of `collect`; what is not found is in the tail.
      const Mask near = at_least(up.furthest * 1.001f, distance(at, f, reach));
      Mask sought = both(near, at_least(alpha, splat(kCoreAlphaMin * 0.999f)));
      for (int k = 0; k < fragments.filled && any(sought); ++k) {
        const Mask found = both(sought, equal(fragments.core[k].gaussian, gaussian));
        unit = select(found, fragments.core[k].distance, unit);
        mean = select(found, zero(), mean);
        behind = select(found, fragments.core[k].alpha, behind);
        sought = without(sought, found);
      }
      const Vec weight = alpha * unit;
      const Vec signal = up.signal(f_red, f_green, f_blue, f_depth) - mean;
      const Vec m = keep(less(full, splat(kAlphaMax)), weight * signal - behind * (alpha * reciprocal(1.0f - alpha)));
      red += weight * up.red;
      green += weight * up.green;
      blue += weight * up.blue;
      depth += weight * up.depth;
      moments.add(at, m);
      if constexpr (Seen::kOfRays)
        if (args.grad_rays) g.add_ray_gradient(at, m, ray_gradients[column.number(row)]);
    }
    Vec sums[kMoments];
    moments.finish(sums);
    sums[10] = red, sums[11] = green, sums[12] = blue, sums[13] = depth;
    sums[14] = sums[15] = zero();
    float totals[kMoments];
    for (int k = 0; k < kMoments; k += 4) sum4(sums + k, totals + k);
    float *out = args.moments + int64_t(instance.slot) * kMoments;
    const bool first = column.index == instance.column;
    for (int k = 0; k < kMoments; ++k) out[k] = first ? totals[k] : out[k] + totals[k];
  }
}

template <class Seen>
void backward_tile(const BlendGradientArguments &args, const Tile &tile) {
  const Places<Seen> &places = places_of<Seen>(args.forward, tile);
  Places<Seen> ray_gradients;
  if constexpr (Seen::kOfRays)
    if (args.grad_rays) ray_gradients.resize(tile.patches());
  Upstream upstream[kPatchesInColumn];
  for (int i = 0; i < tile.patch_columns; ++i) {
    const PatchColumn column(args.forward, tile, i);
    collect<Seen>(column, places);
    for (int row = 0; row < tile.patch_rows; ++row) upstream[row] = differentiate_patch(args, column, row);
    add_moments<Seen>(args, column, upstream, places, ray_gradients);
  }
  if constexpr (Seen::kOfRays)
    if (args.grad_rays) add_ray_gradients(args, tile, ray_gradients);
}

bool planar(const BlendArguments &args) { return args.projection == kErp || args.projection == kPinhole; }

void hybrid_forward(const BlendArguments &args) {
  for_each_tile(args, [&](const Tile &tile, int64_t index) {
    planar(args) ? forward_tile<PlanarFootprint>(args, tile, index) : forward_tile<ProjectiveFootprint>(args, tile, index);
  });
}

void hybrid_backward(const BlendGradientArguments &args) {
  for_each_tile(args.forward, [&](const Tile &tile, int64_t) {
    planar(args.forward) ? backward_tile<PlanarFootprint>(args, tile) : backward_tile<ProjectiveFootprint>(args, tile);
  });
}

}  // namespace

extern const BlendKernels hybrid_kernels;
const BlendKernels hybrid_kernels = {hybrid_forward, hybrid_backward};

}  // namespace PADGS_ISA
}  // namespace padgs
