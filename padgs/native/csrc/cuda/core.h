// The fragments of one pixel for hybrid blending: the nearest few in order, and sums over all others; fragments.h keeps
// those of sixteen for the CPU. The definition is padgs/render/backends/torch.py.
#pragma once

#include "../abi.h"
#include "../mathematics/scalar.h"

namespace padgs {

struct Fragment {
  float distance, alpha;
  int32_t gaussian;
};

// Up to `size` <= kRoom fragments, by distance; equal distances stay in the order of arrival.
template <int kRoom>
struct Core {
  Fragment places[kRoom];
  int size, filled = 0;

  PADGS_HD explicit Core(int size) : size(size) {}

  // Returns the one for which there is no place, of alpha 0 if there was one for all. Searches from the back, as
  // fragments mostly come front to back.
  PADGS_HD Fragment insert(const Fragment &fragment) {
    Fragment evicted{0.0f, 0.0f, -1};
    if (filled == size) {
      evicted = places[size - 1];
      if (!(fragment.distance < evicted.distance)) return fragment;
      --filled;
    }
    int k = filled++;
    for (; k > 0 && fragment.distance < places[k - 1].distance; --k) places[k] = places[k - 1];
    places[k] = fragment;
    return evicted;
  }
};

// Sums over the fragments outside the core; independent of order up to rounding.
struct alignas(8) Tail {
  float alpha, left;               // sum of alpha, product of 1 - alpha
  float red, green, blue, depth;  // sums of alpha times them

  PADGS_HD void add(float a, const Footprint &f) {
    alpha += a;
    left -= left * a;
    red += a * f.red;
    green += a * f.green;
    blue += a * f.blue;
    depth += a * f.depth;
  }
  // The opacity of the tail's layer for each unit of alpha in it.
  PADGS_HD float opacity_per_alpha() const { return alpha > 0 ? (1.0f - left) / alpha : 0.0f; }
};
static_assert(sizeof(Tail) == 24, "padgs/render/backends/cuda.py allocates 6 floats per pixel");

// Transmittance `left` behind a core fragment; 0 below the threshold.
PADGS_HD float left_behind(float left, float weight) {
  const float next = left - weight;
  return next >= kTransmittanceMin ? next : 0.0f;
}

// State for the derivatives of the fragments of a pixel. With s the signal of a fragment (upstream gradient of its colour
// and depth times these), a fragment of weight alpha u has
//   dL/dalpha = u (s - mean) - behind / (1 - alpha),
// in the core u = transmittance in front, mean = 0, behind = weighted signals behind it, background included;
// in the tail u = T (1 - Q) / Z, mean = mean signal of the tail, behind = T Q (signal of the background - mean).
struct alignas(8) CoreGradient {
  float unit, behind;
};
struct alignas(16) TailGradient {
  float unit, mean, behind;
  float offset;  // of every signal: depth is a mean, whose derivative by a weight is (z - depth) / sum of weights
};

}  // namespace padgs
