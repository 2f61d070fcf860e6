// Sixteen items of an array of N x width floats, one vector for each of their values.
#pragma once

#include <algorithm>
#include <cstdint>

#include "simd.h"

namespace padgs {
namespace PADGS_ISA {

// Lanes past the end repeat the last item.
template <int kWidth>
PADGS_INLINE void load_items(const float *array, int64_t first, int64_t count, Vec *out) {
  float lanes[kWidth][kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    const float *item = array + std::min(first + lane, count - 1) * kWidth;
    for (int k = 0; k < kWidth; ++k) lanes[k][lane] = item[k];
  }
  for (int k = 0; k < kWidth; ++k) out[k] = load(lanes[k]);
}

template <int kWidth>
PADGS_INLINE void store_items(float *array, int64_t first, int64_t count, const Vec *in) {
  float lanes[kWidth][kLanes];
  for (int k = 0; k < kWidth; ++k) store(lanes[k], in[k]);
  const int end = int(std::min<int64_t>(kLanes, count - first));
  for (int lane = 0; lane < end; ++lane)
    for (int k = 0; k < kWidth; ++k) array[(first + lane) * kWidth + k] = lanes[k][lane];
}

}  // namespace PADGS_ISA
}  // namespace padgs
