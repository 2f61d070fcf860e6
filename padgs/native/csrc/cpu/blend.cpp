// Blending: one thread owns one tile at a time, one vector lane is one pixel of a patch. Paper Eq. 4-5.
//
// Forward takes a tile's instances in batches, front to back: it notes which patches each reaches, then finishes one
// patch after the other, whose pixels stay in registers. Backward goes back to front, a few instances at a time: for
// each it sums M = dL/d(ln alpha) times powers over the patches, which planar.h and projective.h turn into derivatives.
#include <algorithm>
#include <cmath>
#include <vector>

#include "batch.h"
#include "hits.h"
#include "kernels.h"
#include "pixels.h"
#include "tiles.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

struct ForwardPatch {
  Vec transmittance;  // negative once the pixel has stopped
  Vec red = zero(), green = zero(), blue = zero(), depth = zero();
  Vec coverage = zero();  // sum of weights; 1 - transmittance would leave few digits of a faint pixel
  VecI last = zero_int();
  bool alive = true;
};

void store_patch(const BlendArguments &args, const Patch &patch, const ForwardPatch &state) {
  const Vec t = maximum(state.transmittance, -state.transmittance);
  float lanes[5][kLanes];
  store(lanes[0], state.red + t * args.background[0]);
  store(lanes[1], state.green + t * args.background[1]);
  store(lanes[2], state.blue + t * args.background[2]);
  store(lanes[3], t);
  store(lanes[4], select(less(zero(), state.coverage), state.depth / state.coverage, zero()));
  int32_t last[kLanes];
  store_int(last, state.last);
  patch.each_pixel([&](int lane, int64_t pixel) {
    for (int channel = 0; channel < 3; ++channel) args.image[3 * pixel + channel] = lanes[channel][lane];
    args.transmittance[pixel] = lanes[3][lane];
    args.depth[pixel] = lanes[4][lane];
    args.last[pixel] = last[lane];
  });
}

// Blends `entries` instances of a batch, those of `list`, into one patch; `position` is that of the batch in the
// tile's list.
template <class Seen>
int64_t blend_patch(const Seen *batch, const uint8_t *list, int entries, int position,
                    const typename Seen::Place &place, ForwardPatch &out) {
  ForwardPatch s = out;
  int64_t contributing = 0;
  for (int k = 0; k < entries; ++k) {
    const Seen &g = batch[list[k]];
    const typename Seen::At at = g.at(place);
    const Vec alpha = minimum(exp2_fast(at.log2_alpha), splat(kAlphaMax));
    const Vec next = s.transmittance - s.transmittance * alpha;
    // A stopped pixel has a negative transmittance, so `next` never passes for it.
    const Mask drawn = both(at.reached, at_least(next, splat(kTransmittanceMin)));
    const Vec weight = keep(drawn, alpha * s.transmittance);
    const Mask stopping = without(both(at.reached, at_least(s.transmittance, zero())), drawn);
    s.red += weight * g.red;
    s.green += weight * g.green;
    s.blue += weight * g.blue;
    s.depth += weight * g.depth;
    s.coverage += weight;
    s.last = select_int(drawn, splat_int(position + list[k] + 1), s.last);
    s.transmittance = select(drawn, next, s.transmittance);
    contributing += count(drawn);
    if (any(stopping)) {
      s.transmittance = select(stopping, -s.transmittance, s.transmittance);
      s.alive = any(at_least(s.transmittance, zero()));
      if (!s.alive) break;
    }
  }
  out = s;
  return contributing;
}

template <class Seen>
void forward_tile(const BlendArguments &args, const Tile &tile, int64_t index) {
  static thread_local std::vector<ForwardPatch> storage;
  const int patches = tile.patches();
  storage.resize(patches);
  ForwardPatch *states = storage.data();
  Batch<Seen> &batch = batch_of_thread<Seen>();
  const std::vector<typename Seen::Place> &places = places_of<Seen>(args, tile);
  int alive = patches;
  for (int p = 0; p < patches; ++p) states[p] = {Patch(tile, p, args.grid.width).inside()};
  int64_t evaluated = 0, contributing = 0;

  for (int64_t start = tile.first; start < tile.end && alive; start += kBatch) {
    batch.load(args, tile, start);
    for (int p = 0; p < patches; ++p) {
      if (!batch.count(p) || !states[p].alive) continue;
      evaluated += kLanes * batch.count(p);
      contributing +=
          blend_patch(batch.seen(), batch.list(p), batch.count(p), int(start - tile.first), places[p], states[p]);
      alive -= !states[p].alive;
    }
  }

  for (int p = 0; p < patches; ++p) store_patch(args, Patch(tile, p, args.grid.width), states[p]);
  args.pair_counts[2 * index] = evaluated;
  args.pair_counts[2 * index + 1] = contributing;
}

struct BackwardPatch {
  Vec transmittance;  // in front of the Gaussian being visited
  Vec behind;         // sum of weight * (dL/dcolour . colour) behind it, background included
  Vec grad_red, grad_green, grad_blue, grad_depth;
  VecI last;
};

// Loads the upstream gradients of one patch; returns the largest `last` of its pixels.
int load_patch(const BlendGradientArguments &args, const Patch &patch, BackwardPatch &state) {
  const BlendArguments &forward = args.forward;
  float t[kLanes], behind[kLanes] = {}, grad[3][kLanes] = {}, grad_depth[kLanes] = {};
  int32_t last[kLanes] = {}, furthest = 0;
  std::fill_n(t, kLanes, 1.0f);
  patch.each_pixel([&](int lane, int64_t pixel) {
    t[lane] = forward.transmittance[pixel];
    float grad_t = args.grad_transmittance ? args.grad_transmittance[pixel] : 0.0f;
    for (int channel = 0; channel < 3; ++channel) {
      grad[channel][lane] = args.grad_image[3 * pixel + channel];
      grad_t += grad[channel][lane] * forward.background[channel];
    }
    if (args.grad_depth && t[lane] < 1) {  // depth = sum(w r) / (1 - T)
      grad_depth[lane] = args.grad_depth[pixel] / (1.0f - t[lane]);
      grad_t += grad_depth[lane] * forward.depth[pixel];
    }
    behind[lane] = t[lane] * grad_t;
    last[lane] = forward.last[pixel];
    furthest = std::max(furthest, last[lane]);
  });
  state = {load(t), load(behind), load(grad[0]), load(grad[1]), load(grad[2]), load(grad_depth), load_int(last)};
  return furthest;
}

// A patch that an instance draws in.
template <class Seen>
struct Hit {
  typename Seen::Factors factors;
  Vec alpha, b_by_d;  // not limited, 0 where nothing is drawn; with rays only
  int patch;
};

// kAbsgrad: with `absgrad`, see BlendGradientArguments.
template <class Seen, bool kWithDepth, bool kWithRays, bool kAbsgrad>
void backward_tile(const BlendGradientArguments &args, const Tile &tile) {
  const BlendArguments &forward = args.forward;
  static thread_local std::vector<BackwardPatch> storage;
  static thread_local std::vector<Hit<Seen>> hit_storage(kHits + kMostPatches);
  const int patches = tile.patches();
  storage.resize(patches);
  BackwardPatch *states = storage.data();
  Hit<Seen> *hits = hit_storage.data();
  Entrant entrants[kEntrants];
  const std::vector<typename Seen::Place> &places = places_of<Seen>(forward, tile);
  std::vector<typename Seen::Place> ray_gradients;
  if constexpr (kWithRays) ray_gradients.resize(patches);
  int furthest = 0;
  for (int p = 0; p < patches; ++p)
    furthest = std::max(furthest, load_patch(args, Patch(tile, p, forward.grid.width), states[p]));

  for (int64_t i = tile.first + furthest; i < tile.end; ++i)
    std::fill_n(args.gradient_sums + int64_t(forward.instances[i].slot) * kGradientSums, kGradientSums, 0.0f);
  for (int64_t i = tile.first + furthest - 1; i >= tile.first;) {
    int count = 0, found = 0;
    for (; i >= tile.first && count < kEntrants && found < kHits; --i, ++count) {
      prefetch(args, i - kAhead, tile.first, tile.end);
      const Instance instance = forward.instances[i];
      const Seen g(forward.footprints[instance.gaussian], forward, tile);
      const VecI position = splat_int(int32_t(i - tile.first) + 1);
      for_each_patch(tile, instance, [&](int p) {
        const typename Seen::At at = g.at(places[p]);
        const Mask drawn = both(at.reached, at_most(position, states[p].last));
        Hit<Seen> &hit = hits[found];  // the next overwrites it where nothing is drawn
        hit.factors = at.factors;
        if constexpr (kWithRays) hit.b_by_d = at.b_by_d;
        hit.alpha = keep(drawn, exp2_fast(at.log2_alpha));
        hit.patch = p;
        found += any(drawn);
      });
      entrants[count] = {instance.gaussian, instance.slot, found};
    }
    const Hit<Seen> *hit = hits;
    for (int e = 0; e < count; ++e) {
      const Footprint &g = forward.footprints[entrants[e].gaussian];
      const Seen seen(g, forward, tile);
      typename Seen::GradientSums gradient_sums(seen);
      Vec red = zero(), green = zero(), blue = zero(), depth = zero(), absgrad = zero();
      for (const Hit<Seen> *end = hits + entrants[e].end; hit < end; ++hit) {
        BackwardPatch &state = states[hit->patch];
        const Vec alpha = minimum(hit->alpha, splat(kAlphaMax));
        const Vec inverse = reciprocal(1.0f - alpha);
        state.transmittance = state.transmittance * inverse;
        const Vec weight = alpha * state.transmittance;
        Vec signal = state.grad_red * g.red + state.grad_green * g.green + state.grad_blue * g.blue;
        if (kWithDepth) signal += state.grad_depth * g.depth;
        signal = signal * weight;
        // alpha dL/dalpha = T alpha (c . G) - (contribution behind) alpha / (1 - alpha), and 0 where alpha is limited.
        const Vec m = keep(less(hit->alpha, splat(kAlphaMax)), signal - state.behind * (inverse * alpha));
        state.behind += signal;
        red += weight * state.grad_red;
        green += weight * state.grad_green;
        blue += weight * state.grad_blue;
        if (kWithDepth) depth += weight * state.grad_depth;
        gradient_sums.add(hit->factors, m);
        if constexpr (kAbsgrad) absgrad += seen.absgrad(hit->factors, m);
        if constexpr (kWithRays) seen.add_ray_gradient(hit->factors, hit->b_by_d, m, ray_gradients[hit->patch]);
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

void blend_forward(const BlendArguments &args) {
  for_each_tile(args, [&](const Tile &tile, int64_t index) {
    if (planar(args))
      forward_tile<PlanarFootprint>(args, tile, index);
    else
      forward_tile<ProjectiveFootprint>(args, tile, index);
  });
}

void blend_backward(const BlendGradientArguments &args) {
  for_each_tile(args.forward, [&](const Tile &tile, int64_t) {
    if (planar(args.forward))  // does not look at rays
      args.grad_depth ? backward_tile<PlanarFootprint, true, false, false>(args, tile)
                      : backward_tile<PlanarFootprint, false, false, false>(args, tile);
    else if (args.grad_rays)
      backward_tile<ProjectiveFootprint, true, true, true>(args, tile);
    else if (args.absgrad)
      args.grad_depth ? backward_tile<ProjectiveFootprint, true, false, true>(args, tile)
                      : backward_tile<ProjectiveFootprint, false, false, true>(args, tile);
    else
      args.grad_depth ? backward_tile<ProjectiveFootprint, true, false, false>(args, tile)
                      : backward_tile<ProjectiveFootprint, false, false, false>(args, tile);
  });
}

}  // namespace

extern const BlendKernels blend_kernels;
const BlendKernels blend_kernels = {blend_forward, blend_backward};

}  // namespace PADGS_ISA
}  // namespace padgs
