// From outputs of the networks to attributes of a Gaussian (paper Eq. 13-15), and from their gradients back to those of
// the outputs: for kernels that read outputs from memory and for kernels that compute them.
#pragma once

#include "arguments.h"
#include "device.cuh"

namespace padgs {

// Outputs of each network for a Gaussian: its opacity, its colour, and how far it shrinks along three axes with its
// quaternion.
constexpr int kOpacityValues = 1, kColorValues = 3, kShrinkage = 3, kCovarianceValues = 7;

__device__ inline float sigmoid(float x) { return quick_inverse(1.0f + expf(-x)); }

// The row of a slot's Gaussian. Selected ones come first; others, zeros that are not drawn, fill the rest.
struct Row {
  int64_t index;
  bool selected, written;
};
// `before` of all `count` selected Gaussians have a lower slot.
__device__ inline Row row_of(int64_t slot, bool selected, int64_t before, int64_t count, int64_t room) {
  const int64_t index = selected ? before : count + slot - before;
  return {index, selected, index < room};
}

// Attributes of a Gaussian from the outputs of the colour and covariance networks.
__device__ inline void place(const DecodeArguments &args, int64_t anchor, int64_t slot, const Row &row,
                             const float (&color)[kColorValues], const float (&covariance)[kCovarianceValues]) {
  const float *logs = args.log_scales + 6 * anchor;
  const int64_t n = row.index;
  args.slots[n] = slot;
  args.opacities[n] = row.selected ? args.raw_opacities[slot] * args.attenuation[anchor] : 0.0f;
  for (int c = 0; c < 3; ++c) {
    const float mean = args.positions[3 * anchor + c] + expf(logs[c]) * args.offset_rows[3 * slot + c];
    args.means[3 * n + c] = row.selected ? mean : 0.0f;
    args.scales[3 * n + c] = row.selected ? expf(logs[3 + c]) * sigmoid(covariance[c]) : 0.0f;
    args.colors[3 * n + c] = row.selected ? sigmoid(color[c]) : 0.0f;
  }
  for (int c = 0; c < 4; ++c) args.quats[4 * n + c] = row.selected ? covariance[kShrinkage + c] : 0.0f;
}

// dL by output `c` of a network for the selected Gaussian in row `n`.
template <int kValues>
__device__ float output_gradient(const DecodeGradientArguments &args, int64_t anchor, int64_t slot, int64_t n, int c) {
  const DecodeArguments &in = args.forward;
  if constexpr (kValues == kOpacityValues) {
    const float raw = in.raw_opacities[slot];
    return args.opacities[n] * in.attenuation[anchor] * (1 - raw * raw);
  } else if constexpr (kValues == kColorValues) {
    const float color = in.colors[3 * n + c];
    return args.colors[3 * n + c] * color * (1 - color);
  } else if (c < kShrinkage) {  // scale = size * s with s a sigmoid
    const float scale = in.scales[3 * n + c], inverse_size = expf(-in.log_scales[6 * anchor + 3 + c]);
    return args.scales[3 * n + c] * scale * (1 - scale * inverse_size);
  } else {
    return args.quats[4 * n + c - kShrinkage];
  }
}

}  // namespace padgs
