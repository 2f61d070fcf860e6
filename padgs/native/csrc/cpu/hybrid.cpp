// Hybrid blending: each pixel keeps its K nearest fragments in order and blends the rest as one layer behind them. The
// definition is padgs/render/backends/torch.py. The tile lists may be in any order; front to back is fast.
//
// Forward collects the fragments of each patch, and keeps the core. Backward turns the core into layers, one
// for each instance that is in it, in the order of the list, and then visits the list.
#include <cmath>
#include <vector>

#include "batch.h"
#include "fragments.h"
#include "hits.h"
#include "kept_cores.h"
#include "kernels.h"
#include "pixels.h"
#include "tiles.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

// Where a Gaussian lies on the rays: for `ray` at its largest value there, |M^-1 mean| b / D; else at its mean.
float ray_reach(const BlendArguments &args, const ProjectiveFootprint &g) {
  return args.projection == kRay ? 1.0f / std::sqrt(g.f.shape[9]) : 0.0f;
}
float ray_reach(const BlendArguments &, const PlanarFootprint &) { return 0.0f; }
Vec distance(const ProjectiveFootprint::At &at, const ProjectiveFootprint &g, float reach) {
  return reach > 0 ? at.b_by_d * reach : splat(g.depth);
}
Vec distance(const PlanarFootprint::At &, const PlanarFootprint &g, float) { return splat(g.depth); }

template <class Seen>
using Places = std::vector<typename Seen::Place>;

const Footprint &footprint_of(const BlendArguments &args, const Tile &tile, const Fragments &fragments,
                              const Row &row) {
  return args.footprints[args.instances[tile.first + fragments.entrants[row.entrant]].gaussian];
}

constexpr int kChunk = 16;  // instances that are evaluated, which needs no jumps, before any is given its place

// Adds the instances of a batch to the fragments of patch `p`; `position` is that of the batch in the tile's list.
template <class Seen>
void collect_patch(const Batch<Seen> &batch, const float *reach, int p, int position, const typename Seen::Place &place,
                   Mask inside, Vec core_size, Fragments &fragments) {
  const uint8_t *list = batch.list(p);
  const int entries = batch.count(p);
  Tail tail = fragments.tail;
  Vec reached = fragments.reached, entered = fragments.entered;
  Vec alphas[kChunk], aways[kChunk];
  for (int start = 0; start < entries; start += kChunk) {
    const int size = std::min(kChunk, entries - start);
    for (int k = 0; k < size; ++k) {
      const int i = list[start + k];
      const Seen &g = batch.seen()[i];
      const typename Seen::At at = g.at(place);
      alphas[k] = keep(both(at.reached, inside), minimum(exp2_fast(at.log2_alpha), splat(kAlphaMax)));
      aways[k] = distance(at, g, reach[i]);
    }
    fragments.reserve(kChunk);
    Row *const rows = fragments.rows;
    int32_t *const entrants = fragments.entrants;
    int count = fragments.row_count, last = fragments.last, entrant = fragments.entrant_count;
    Vec furthest = rows[last].distance;
    for (int k = 0; k < size; ++k) {
      const int i = list[start + k];
      const Vec alpha = alphas[k], away = aways[k];
      const Mask nearer = less(away, furthest);
      const Mask entering = both(at_least(alpha, splat(kCoreAlphaMin)), either(nearer, less(entered, core_size)));
      tail.add(alpha - keep(entering, alpha), batch.seen()[i]);
      reached += keep(less(zero(), alpha), splat(1.0f));
      entered += keep(entering, splat(1.0f));
      const Mask early = both(entering, nearer), late = without(entering, nearer);
      if (any(early)) {
        count = insert(rows, count, last, early, away, alpha, entrant);
        fragments.in_order = false;
      }
      furthest = select(late, away, furthest);
      // Written in any case, which is cheaper than to ask; the next overwrites it.
      rows[count] = {furthest, keep(late, alpha), entrant, last};
      entrants[entrant] = position + i;
      const int added = any(late);  // no jump may depend on it: none could be predicted
      last += (count - last) * added;
      count += added, entrant += any(entering);
    }
    fragments.row_count = count, fragments.last = last, fragments.entrant_count = entrant;
  }
  fragments.tail = tail;
  fragments.reached = reached, fragments.entered = entered;
}

// The fragments of all patches of a tile; this thread's, until it asks for the next. Counts the evaluated pairs.
template <class Seen>
std::vector<Fragments> &collect(const BlendArguments &args, const Tile &tile, const Places<Seen> &places,
                                int64_t &evaluated) {
  static thread_local std::vector<Fragments> storage;
  const int patches = tile.patches();
  if (int(storage.size()) < patches) storage.resize(patches);
  for (int p = 0; p < patches; ++p) storage[p].clear();
  Batch<Seen> &batch = batch_of_thread<Seen>();
  float reach[kBatch];
  const Vec core_size = splat(float(args.core_size));
  for (int64_t start = tile.first; start < tile.end; start += kBatch) {
    batch.load(args, tile, start);
    for (int i = 0; i < batch.size(); ++i) reach[i] = ray_reach(args, batch.seen()[i]);
    for (int p = 0; p < patches; ++p) {
      if (!batch.count(p)) continue;
      Fragments &fragments = storage[p];
      const Mask inside = less(zero(), Patch(tile, p, args.grid.width).inside());
      collect_patch<Seen>(batch, reach, p, int(start - tile.first), places[p], inside, core_size, fragments);
      fragments.close(args.core_size, [&](const Row &row) { return footprint_of(args, tile, fragments, row); });
      evaluated += kLanes * batch.count(p);
    }
  }
  return storage;
}

// Transmittance `left` behind a core fragment; 0 below the threshold.
Vec left_behind(Vec left, Vec weight) {
  const Vec next = left - weight;
  return keep(at_least(next, splat(kTransmittanceMin)), next);
}

// (1 - left) / (sum of alpha): the opacity of the tail's layer, for each unit of alpha in it.
Vec opacity_per_alpha(const Tail &tail) {
  const Mask some = less(zero(), tail.alpha);
  return keep(some, (1.0f - tail.left) / select(some, tail.alpha, splat(1.0f)));
}

int64_t blend_patch(const BlendArguments &args, const Tile &tile, const Patch &patch, const Fragments &fragments) {
  const Tail &tail = fragments.tail;
  Vec left = splat(1.0f), red = zero(), green = zero(), blue = zero(), depth = zero(), coverage = zero();
  int64_t contributing = 0;
  for (int k = 1; k < fragments.row_count; ++k) {
    const Row &row = fragments.rows[k];
    const Vec weight = row.alpha * left;
    const Footprint &c = footprint_of(args, tile, fragments, row);
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
  contributing += int64_t(sum(keep(less(zero(), left), fragments.reached - fragments.entered)));
  float lanes[5][kLanes];
  store(lanes[0], red + share * tail.red + transmittance * args.background[0]);
  store(lanes[1], green + share * tail.green + transmittance * args.background[1]);
  store(lanes[2], blue + share * tail.blue + transmittance * args.background[2]);
  store(lanes[3], transmittance);
  store(lanes[4], select(less(zero(), coverage), (depth + share * tail.depth) / coverage, zero()));
  patch.each_pixel([&](int lane, int64_t pixel) {
    for (int channel = 0; channel < 3; ++channel) args.image[3 * pixel + channel] = lanes[channel][lane];
    args.transmittance[pixel] = lanes[3][lane];
    args.depth[pixel] = lanes[4][lane];
  });
  return contributing;
}

// Keeps the cores of a tile, whose words go to the next free place.
void keep_tile(const BlendArguments &args, const Tile &tile, int64_t index, const std::vector<Fragments> &fragments) {
  static thread_local std::vector<int32_t> words;
  words.clear();
  for (int p = 0; p < tile.patches(); ++p) keep_patch(fragments[p], words);
  int64_t &used = args.core_start[args.grid.row_start[args.grid.end_row - args.grid.first_row]];
  const int64_t start = __atomic_fetch_add(&used, int64_t(words.size()), __ATOMIC_RELAXED);
  std::copy(words.begin(), words.end(), args.cores + start);
  args.core_start[index] = start;
}

template <class Seen>
void forward_tile(const BlendArguments &args, const Tile &tile, int64_t index) {
  int64_t evaluated = 0, contributing = 0;
  const std::vector<Fragments> &fragments = collect<Seen>(args, tile, places_of<Seen>(args, tile), evaluated);
  if (args.cores) keep_tile(args, tile, index, fragments);
  for (int p = 0; p < tile.patches(); ++p)
    contributing += blend_patch(args, tile, Patch(tile, p, args.grid.width), fragments[p]);
  args.pair_counts[2 * index] = evaluated;
  args.pair_counts[2 * index + 1] = contributing;
}

// Upstream gradients of a patch, and state for the derivatives of its tail fragments. With s the signal of a
// fragment (upstream gradient of its colour and depth times these), a fragment of weight alpha u has
//   dL/dalpha = u (s - mean) - behind / (1 - alpha),
// in the core u = transmittance in front, mean = 0, behind = weighted signals behind it, background included;
// in the tail u = T (1 - Q) / Z, mean = mean signal of the tail, behind = T Q (signal of the background - mean).
struct Upstream {
  Vec red, green, blue, depth, offset;
  Vec unit, mean, behind;  // of the tail

  template <class T>
  Vec signal(T r, T g, T b, T d) const { return red * r + green * g + blue * b + depth * d + offset; }
};

// State for the derivatives of the core fragments of an instance in one patch.
struct Layer {
  Vec front, behind;  // u and `behind` as above; front < 0 where it is not in the core
  int32_t position;   // of the instance in the tile's list
};
constexpr float kNotInCore = -1.0f;

// Loads a patch, and writes its layers.
template <class Seen>
Upstream differentiate_patch(const BlendGradientArguments &args, const Tile &tile, const Patch &patch,
                             const typename Seen::Place &place, const KeptPatch &kept, Layer *layers) {
  struct Fragment {
    Vec alpha, front;
    const Footprint *footprint;
  };
  static thread_local std::vector<Fragment> core;
  const BlendArguments &forward = args.forward;
  const Tail &tail = kept.tail;
  float grad[3][kLanes] = {}, through[kLanes] = {}, depth[kLanes] = {}, grad_depth[kLanes] = {};
  patch.each_pixel([&](int lane, int64_t pixel) {
    if (args.grad_transmittance) through[lane] = args.grad_transmittance[pixel];
    for (int channel = 0; channel < 3; ++channel) {
      grad[channel][lane] = args.grad_image[3 * pixel + channel];
      through[lane] += grad[channel][lane] * forward.background[channel];
    }
    if (args.grad_depth) depth[lane] = forward.depth[pixel], grad_depth[lane] = args.grad_depth[pixel];
  });
  Upstream up;
  Vec left = splat(1.0f), coverage = zero();
  core.resize(kept.rows);
  const auto footprint_at = [&](int k) {
    return forward.footprints + forward.instances[tile.first + kept.positions[entrant_of(kept.row[k])]].gaussian;
  };
  for (int k = 0; k < kept.rows; ++k) {
    if (k + kAhead < kept.rows) __builtin_prefetch(footprint_at(k + kAhead));
    const Footprint &footprint = *footprint_at(k);
    const typename Seen::At at = Seen(footprint, forward, tile).at(place);
    const Vec alpha = keep(lanes_of(lanes_bits_of(kept.row[k])), minimum(exp2_fast(at.log2_alpha), splat(kAlphaMax)));
    const Vec weight = alpha * left;
    core[k] = {alpha, left, &footprint};
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
  for (int e = 0; e < kept.entrants; ++e) layers[e] = {splat(kNotInCore), zero(), kept.positions[e]};
  Vec behind = up.unit * tail.alpha * up.mean + left * tail.left * load(through);
  for (int k = kept.rows - 1; k >= 0; --k) {
    const Fragment &fragment = core[k];
    const Mask filled = lanes_of(lanes_bits_of(kept.row[k]));
    Layer &layer = layers[entrant_of(kept.row[k])];
    layer.front = select(filled, fragment.front, layer.front);
    layer.behind = select(filled, behind, layer.behind);
    const Footprint &c = *fragment.footprint;
    behind += fragment.alpha * fragment.front * up.signal(c.red, c.green, c.blue, c.depth);
  }
  return up;
}

// A patch that an instance draws in.
template <class Seen>
struct Hit {
  typename Seen::Factors factors;
  Vec alpha, b_by_d;   // not limited, 0 where nothing is drawn; with rays only
  const Layer *layer;  // of its core fragments
  int patch;
};

// kAbsgrad: with `absgrad`, see BlendGradientArguments.
template <class Seen, bool kWithDepth, bool kWithRays, bool kAbsgrad>
void backward_tile(const BlendGradientArguments &args, const Tile &tile, int64_t index) {
  const BlendArguments &forward = args.forward;
  const Places<Seen> &places = places_of<Seen>(forward, tile);
  Places<Seen> ray_gradients;
  if constexpr (kWithRays) ray_gradients.resize(tile.patches());

  static thread_local std::vector<Upstream> upstream;
  static thread_local std::vector<Layer> layers;
  static thread_local std::vector<const Layer *> next;  // [patches] the next instance of each patch that is in its core
  static thread_local std::vector<KeptPatch> kept;
  const int patches = tile.patches();
  const int32_t *words = forward.cores + forward.core_start[index];
  size_t layer_count = 0;
  kept.clear();
  for (int p = 0; p < patches; ++p) {
    kept.emplace_back(words);
    layer_count += kept.back().entrants + 1;
  }
  if (layers.size() < layer_count) layers.resize(layer_count);
  upstream.clear(), next.clear();
  Layer *layer = layers.data();
  for (int p = 0; p < patches; ++p) {
    next.push_back(layer);
    upstream.push_back(
        differentiate_patch<Seen>(args, tile, Patch(tile, p, forward.grid.width), places[p], kept[p], layer));
    layer += kept[p].entrants;
    (layer++)->position = -1;
  }

  static thread_local std::vector<Hit<Seen>> hit_storage(kHits + kMostPatches);
  Hit<Seen> *hits = hit_storage.data();
  Entrant entrants[kEntrants];
  const Layer none = {splat(kNotInCore), zero(), -1};
  for (int64_t i = tile.first; i < tile.end;) {
    int count = 0, found = 0;
    for (; i < tile.end && count < kEntrants && found < kHits; ++i, ++count) {
      prefetch(args, i + kAhead, tile.first, tile.end);
      const Instance instance = forward.instances[i];
      const Seen g(forward.footprints[instance.gaussian], forward, tile);
      for_each_patch(tile, instance, [&](int p) {
        const Layer *core = next[p];
        const bool in_core = core->position == int32_t(i - tile.first);
        next[p] += in_core;
        const typename Seen::At at = g.at(places[p]);
        Hit<Seen> &hit = hits[found];  // the next overwrites it where nothing is drawn
        hit.factors = at.factors;
        if constexpr (kWithRays) hit.b_by_d = at.b_by_d;
        hit.alpha = keep(at.reached, exp2_fast(at.log2_alpha));
        hit.layer = in_core ? core : &none;
        hit.patch = p;
        found += any(at.reached);
      });
      entrants[count] = {instance.gaussian, instance.slot, found};
    }
    const Hit<Seen> *hit = hits;
    for (int e = 0; e < count; ++e) {
      const Seen g(forward.footprints[entrants[e].gaussian], forward, tile);
      typename Seen::GradientSums gradient_sums(g);
      Vec red = zero(), green = zero(), blue = zero(), depth = zero(), absgrad = zero();
      for (const Hit<Seen> *end = hits + entrants[e].end; hit < end; ++hit) {
        const Upstream &up = upstream[hit->patch];
        const Vec alpha = minimum(hit->alpha, splat(kAlphaMax));
        const Mask in_core = at_least(hit->layer->front, zero());
        const Vec unit = select(in_core, hit->layer->front, up.unit);
        const Vec mean = select(in_core, zero(), up.mean);
        const Vec behind = select(in_core, hit->layer->behind, up.behind);
        const Vec weight = alpha * unit;
        Vec signal = up.red * g.red + up.green * g.green + up.blue * g.blue - mean;
        if (kWithDepth) signal += up.depth * g.depth + up.offset;
        const Vec hidden = behind * (alpha * reciprocal(1.0f - alpha));
        const Vec m = keep(less(hit->alpha, splat(kAlphaMax)), weight * signal - hidden);
        red += weight * up.red;
        green += weight * up.green;
        blue += weight * up.blue;
        if (kWithDepth) depth += weight * up.depth;
        gradient_sums.add(hit->factors, m);
        if constexpr (kAbsgrad) absgrad += g.absgrad(hit->factors, m);
        if constexpr (kWithRays) g.add_ray_gradient(hit->factors, hit->b_by_d, m, ray_gradients[hit->patch]);
      }
      float *out = args.gradient_sums + int64_t(entrants[e].slot) * kGradientSums;
      Vec sums[kGradientSums];
      gradient_sums.finish(sums);
      sums[10] = red, sums[11] = green, sums[12] = blue, sums[13] = depth;
      sums[kAbsgradSum] = absgrad, sums[15] = zero();
      for (int k = 0; k < kGradientSums; k += 8) sum8(sums + k, out + k);
    }
  }
  if constexpr (kWithRays) add_ray_gradients(args, tile, ray_gradients);
}

bool planar(const BlendArguments &args) { return args.projection == kErp || args.projection == kPinhole; }

void hybrid_forward(const BlendArguments &args) {
  for_each_tile(args, [&](const Tile &tile, int64_t index) {
    if (planar(args))
      forward_tile<PlanarFootprint>(args, tile, index);
    else
      forward_tile<ProjectiveFootprint>(args, tile, index);
  });
}

void hybrid_backward(const BlendGradientArguments &args) {
  for_each_tile(args.forward, [&](const Tile &tile, int64_t index) {
    if (planar(args.forward))  // does not look at rays
      args.grad_depth ? backward_tile<PlanarFootprint, true, false, false>(args, tile, index)
                      : backward_tile<PlanarFootprint, false, false, false>(args, tile, index);
    else if (args.grad_rays)
      backward_tile<ProjectiveFootprint, true, true, true>(args, tile, index);
    else if (args.absgrad)
      args.grad_depth ? backward_tile<ProjectiveFootprint, true, false, true>(args, tile, index)
                      : backward_tile<ProjectiveFootprint, false, false, true>(args, tile, index);
    else
      args.grad_depth ? backward_tile<ProjectiveFootprint, true, false, false>(args, tile, index)
                      : backward_tile<ProjectiveFootprint, false, false, false>(args, tile, index);
  });
}

}  // namespace

extern const HybridKernels hybrid_kernels;
const HybridKernels hybrid_kernels = {{hybrid_forward, hybrid_backward}, core_words};

}  // namespace PADGS_ISA
}  // namespace padgs
