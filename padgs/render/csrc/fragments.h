// The fragments of sixteen pixels for hybrid blending: the nearest few in order, and sums over all others.
#pragma once

#include <algorithm>
#include <limits>

#include "abi.h"
#include "simd.h"

namespace padgs {
namespace PADGS_ISA {

constexpr float kCoreAlphaMin = 0.05f;  // fainter fragments go to the tail
const float kEmpty = std::numeric_limits<float>::infinity();

// One place in the core of each pixel. Empty: infinitely far, transparent, of Gaussian -1.
struct Slot {
  Vec distance, alpha;
  VecI gaussian;
};

struct Colors {
  Vec red, green, blue, depth;
};

// What sixteen Gaussians carry, one for each lane; any for -1.
inline Colors gather(const Footprint *footprints, VecI gaussian) {
  int32_t index[kLanes];
  store_int(index, gaussian);
  float lanes[4][kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    const Footprint &f = footprints[std::max(index[lane], 0)];
    lanes[0][lane] = f.red, lanes[1][lane] = f.green, lanes[2][lane] = f.blue, lanes[3][lane] = f.depth;
  }
  return {load(lanes[0]), load(lanes[1]), load(lanes[2]), load(lanes[3])};
}

// Sums over the fragments outside the core; they do not depend on any order but that of rounding.
struct Tail {
  Vec alpha = zero(), left = splat(1.0f), count = zero();  // sum of alpha, product of 1 - alpha, fragments
  Vec red = zero(), green = zero(), blue = zero(), depth = zero();  // sums of alpha times them

  template <class C>
  void add(Vec a, const C &c) {
    alpha += a;
    left = left - left * a;
    count += select(less(zero(), a), splat(1.0f), zero());
    red += a * c.red;
    green += a * c.green;
    blue += a * c.blue;
    depth += a * c.depth;
  }
};

struct Fragments {
  Slot *core;      // [size]
  int size;
  int filled = 0;  // slots that are not empty in all lanes
  Tail tail;

  // Takes one fragment of each lane, alpha = 0 where there is none.
  void add(const Footprint *footprints, int32_t gaussian, Vec distance, Vec alpha) {
    Mask entering = at_least(alpha, splat(kCoreAlphaMin));
    if (filled == size) {
      const Slot &last = core[size - 1];
      entering = both(entering, less(distance, last.distance));
      const Vec evicted = keep(entering, last.alpha);  // 0 where the slot was empty
      if (any(less(zero(), evicted))) tail.add(evicted, gather(footprints, last.gaussian));
    }
    const Vec rest = select(entering, zero(), alpha);
    if (any(less(zero(), rest))) tail.add(rest, footprints[gaussian]);
    if (any(entering)) insert(entering, {distance, alpha, splat_int(gaussian)});
  }

 private:
  // From the back, as fragments mostly come front to back. Equal distances stay in the order of arrival.
  void insert(Mask moving, const Slot &fragment) {
    if (filled < size) core[filled++] = {splat(kEmpty), zero(), splat_int(-1)};
    for (int k = filled - 1;; --k) {
      Slot &here = core[k];
      const Slot &front = core[k > 0 ? k - 1 : 0];
      const Mask further = k > 0 ? both(moving, less(fragment.distance, front.distance)) : without(moving, moving);
      here.distance = select(further, front.distance, select(moving, fragment.distance, here.distance));
      here.alpha = select(further, front.alpha, select(moving, fragment.alpha, here.alpha));
      here.gaussian = select_int(further, front.gaussian, select_int(moving, fragment.gaussian, here.gaussian));
      if (!any(further)) break;
      moving = further;
    }
    if (!any(less(core[filled - 1].distance, splat(kEmpty)))) --filled;
  }
};

}  // namespace PADGS_ISA
}  // namespace padgs
