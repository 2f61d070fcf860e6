// Leave-one-out scores (leave_one_out.h): the backward pass of blend.cpp without derivatives.
#include <algorithm>
#include <vector>

#include "../mathematics/leave_one_out.h"
#include "hits.h"
#include "kernels.h"
#include "pixels.h"
#include "tiles.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

struct RemovalPatch {
  RemovalPixel<Vec> pixels;
  VecI last;
};

// Returns the largest `last` of the pixels of one patch.
int load_patch(const LeaveOneOutArguments &args, const Patch &patch, RemovalPatch &state) {
  const BlendArguments &forward = args.forward;
  float t[kLanes], behind[3][kLanes] = {}, residual[3][kLanes] = {}, weight[kLanes] = {};
  int32_t last[kLanes] = {}, furthest = 0;
  std::fill_n(t, kLanes, 1.0f);
  patch.each_pixel([&](int lane, int64_t pixel) {
    t[lane] = forward.transmittance[pixel];
    weight[lane] = args.weight[pixel];
    for (int channel = 0; channel < 3; ++channel) {
      behind[channel][lane] = t[lane] * forward.background[channel];
      residual[channel][lane] = forward.image[3 * pixel + channel] - args.target[3 * pixel + channel];
    }
    last[lane] = forward.last[pixel];
    furthest = std::max(furthest, last[lane]);
  });
  state.pixels = {load(t),
                  {load(behind[0]), load(behind[1]), load(behind[2])},
                  {load(residual[0]), load(residual[1]), load(residual[2])},
                  load(weight)};
  state.last = load_int(last);
  return furthest;
}

float largest(Vec v) {
  float lanes[kLanes];
  store(lanes, v);
  return *std::max_element(lanes, lanes + kLanes);
}

struct Hit {
  Vec alpha;  // 0 where nothing is drawn
  int patch;
};

template <class Seen>
void leave_one_out_tile(const LeaveOneOutArguments &args, const Tile &tile) {
  const BlendArguments &forward = args.forward;
  static thread_local std::vector<RemovalPatch> storage;
  static thread_local std::vector<Hit> hit_storage(kHits + kMostPatches);
  storage.resize(tile.patches());
  RemovalPatch *states = storage.data();
  Hit *hits = hit_storage.data();
  Entrant entrants[kEntrants];
  const std::vector<typename Seen::Place> &places = places_of<Seen>(forward, tile);
  int furthest = 0;
  for (int p = 0; p < tile.patches(); ++p)
    furthest = std::max(furthest, load_patch(args, Patch(tile, p, forward.grid.width), states[p]));

  for (int64_t i = tile.first + furthest; i < tile.end; ++i)
    std::fill_n(args.removals + int64_t(forward.instances[i].slot) * kRemoval, kRemoval, 0.0f);
  for (int64_t i = tile.first + furthest - 1; i >= tile.first;) {
    int count = 0, found = 0;
    for (; i >= tile.first && count < kEntrants && found < kHits; --i, ++count) {
      if (i - kAhead >= tile.first)
        __builtin_prefetch(forward.footprints + forward.instances[i - kAhead].gaussian);
      const Instance instance = forward.instances[i];
      const Seen g(forward.footprints[instance.gaussian], forward, tile);
      const VecI position = splat_int(int32_t(i - tile.first) + 1);
      for_each_patch(tile, instance, [&](int p) {
        const typename Seen::At at = g.at(places[p]);
        const Mask drawn = both(at.reached, at_most(position, states[p].last));
        hits[found] = {keep(drawn, minimum(exp2_fast(at.log2_alpha), splat(kAlphaMax))), p};
        found += any(drawn);  // the next overwrites it where nothing is drawn
      });
      entrants[count] = {instance.gaussian, instance.slot, found};
    }
    const Hit *hit = hits;
    for (int e = 0; e < count; ++e) {
      const Footprint &g = forward.footprints[entrants[e].gaussian];
      const Vec3<Vec> color{splat(g.red), splat(g.green), splat(g.blue)};
      Vec error = zero(), change = zero(), contribution = zero(), peak = zero();
      for (const Hit *end = hits + entrants[e].end; hit < end; ++hit) {
        RemovalPixel<Vec> &pixels = states[hit->patch].pixels;
        const Removal<Vec> removal = remove_one(pixels, hit->alpha, color);
        error += removal.error;
        change += removal.change;
        contribution += pixels.weight * removal.contribution;
        peak = maximum(peak, removal.contribution);
      }
      float *out = args.removals + int64_t(entrants[e].slot) * kRemoval;
      out[0] = sum(error), out[1] = sum(change), out[2] = sum(contribution), out[3] = largest(peak);
    }
  }
}

void leave_one_out(const LeaveOneOutArguments &args) {
  for_each_tile(args.forward, [&](const Tile &tile, int64_t) {
    if (args.forward.projection == kErp || args.forward.projection == kPinhole)
      leave_one_out_tile<PlanarFootprint>(args, tile);
    else
      leave_one_out_tile<ProjectiveFootprint>(args, tile);
  });
}

}  // namespace

extern const LeaveOneOutKernels leave_one_out_kernels;
const LeaveOneOutKernels leave_one_out_kernels = {leave_one_out};

}  // namespace PADGS_ISA
}  // namespace padgs
