// The decoder's three networks w2 relu(w1 x + b1) + b2 on tensor cores, sixteen anchors a warp. Factors are rounded to a
// reduced type, hidden units and outputs are rounded once, as padgs/anchors/precision.py defines it. Hidden units never
// leave their warp: sums of one product are the factor of the next.
#pragma once

#include <algorithm>

#include "decode.cuh"
#include "mma.cuh"

namespace padgs {

constexpr int kWarps = 4, kThreads = kWarps * kWarp;  // of a block
constexpr int kRows = 16;                             // anchors of a warp
// What there is room for; unused places hold zeros. padgs/anchors/fused_decoder.py asks `padgs_cuda_networks_fit`.
constexpr int kMostInputs = 48;  // with a 1, whose weight is the bias
constexpr int kMostFeatures = 32, kMostHidden = 32, kMostOffsets = 10;
constexpr int kHiddenTiles = kMostHidden / 8;

// Outputs of a network in parts of so many.
template <int kValues, int kSize>
constexpr int kOutputParts = (kValues * kMostOffsets + kSize - 1) / kSize;

// A factor B [16 kSteps, 8 kTiles] in shared memory, as the lanes of a warp take it.
template <int kSteps, int kTiles>
struct Factor {
  FragmentB at[kTiles][kSteps][kWarp];
};

using FirstLayer = Factor<kMostInputs / 16, kHiddenTiles>;
template <int kValues>
using SecondLayer = Factor<kMostHidden / 16, kOutputParts<kValues, 8>>;

// All threads of the block, before a barrier; `number(row, column)` is what goes there.
template <class T, int kSteps, int kTiles, class Number>
__device__ void fill(Factor<kSteps, kTiles> &factor, Number number) {
  for (int i = int(threadIdx.x); i < kSteps * kTiles * kWarp; i += kThreads) {
    const int lane = i % kWarp, step = i / kWarp % kSteps, tile = i / kWarp / kSteps;
    const int row = 16 * step + 2 * (lane % 4), column = 8 * tile + lane / 4;
    factor.at[tile][step][lane] = {packed(number(row, column), number(row + 1, column), T{}),
                                   packed(number(row + 8, column), number(row + 9, column), T{})};
  }
}

template <class T, int kSteps>
__device__ void multiply_add(Sums &sums, const FragmentA (&rows)[kSteps], const FragmentB (&column)[kSteps][kWarp]) {
  for (int step = 0; step < kSteps; ++step) multiply_add(sums, rows[step], column[step][lane_index()], T{});
}

template <class T>
__device__ void fill_first_layer(FirstLayer &layer, const HeadWeights &head, const DecodeArguments &args) {
  fill<T>(layer, [&](int input, int unit) {
    if (unit >= args.hidden || input > args.inputs) return 0.0f;
    return input < args.inputs ? head.w1[unit * args.inputs + input] : head.b1[unit];
  });
}

// Anchors of which a lane has numbers: the one of its group, and eight further on.
struct Anchors {
  int64_t first, end;  // end: behind the last of all
  __device__ Anchors(int64_t tile, int64_t count)
      : first((tile * kWarps + threadIdx.x / kWarp) * kRows + lane_index() / 4), end(count) {}
  __device__ int64_t of(int half) const { return first + 8 * half; }
  __device__ bool there(int half) const { return of(half) < end; }
};

// No more than so many blocks, for each prepares the weights and leaves a gradient of all of them. The number depends on
// nothing else, so that sums have the same order on every GPU.
constexpr int64_t kMostBlocks = 512;
inline int64_t blocks_of_anchors(int64_t anchors) { return std::min(blocks_for(anchors, kWarps * kRows), kMostBlocks); }

// Input `column` of an anchor, and 1 behind the last.
__device__ inline float input(const NetworkInputs &in, int64_t anchor, int column, int count) {
  if (column < in.feature_count) return in.features[anchor * in.feature_count + column];
  const int seen = count - in.feature_count;
  if (column < count) return in.seen[anchor * seen + column - in.feature_count];
  return column == count ? 1.0f : 0.0f;
}

template <class T>
struct InputRows {
  FragmentA steps[kMostInputs / 16];

  __device__ InputRows(const NetworkInputs &in, const Anchors &anchors, int count) {
    for (int step = 0; step < kMostInputs / 16; ++step) {
      for (int i = 0; i < 4; ++i) {
        const int column = 16 * step + i / 2 * 8 + 2 * (lane_index() % 4);
        const int64_t anchor = anchors.of(i % 2);
        const bool there = anchors.there(i % 2);
        steps[step].pairs[i] = packed(there ? input(in, anchor, column, count) : 0.0f,
                                      there ? input(in, anchor, column + 1, count) : 0.0f, T{});
      }
    }
  }
};

// The hidden units of a warp's anchors, already rounded. Those that the network has not are 0, though an input be infinite.
template <class T>
struct HiddenUnits {
  Sums tiles[kHiddenTiles];

  __device__ HiddenUnits(const InputRows<T> &inputs, const FirstLayer &layer, int count) {
    for (int tile = 0; tile < kHiddenTiles; ++tile) {
      Sums &units = tiles[tile] = {};
      multiply_add<T>(units, inputs.steps, layer.at[tile]);
      round_to<T>(units);
      for (int i = 0; i < 4; ++i)
        if (units.of[i] < 0 || 8 * tile + 2 * (lane_index() % 4) + i % 2 >= count) units.of[i] = 0;
    }
  }
  __device__ void as_factors(FragmentA (&steps)[kMostHidden / 16]) const {
    for (int step = 0; step < kMostHidden / 16; ++step)
      steps[step] = as_factor<T>(tiles[2 * step], tiles[2 * step + 1]);
  }
};

// Which Gaussians of an anchor are selected, and how many of anchors before it are. All lanes of a warp ask at once.
struct Selection {
  unsigned bits = 0;
  int64_t start = 0;

  __device__ Selection(const DecodeArguments &args, const Anchors &anchors, int half) {
    const int64_t anchor = anchors.of(half);
    if (anchors.there(half)) {
      start = args.slot_start[anchor];
      for (int k = lane_index() % 4; k < args.offsets; k += 4)
        bits |= unsigned(args.raw_opacities[anchor * args.offsets + k] > 0) << k;
    }
    for (int step = 1; step < 4; step *= 2) bits |= __shfl_xor_sync(kAllLanes, bits, step);
  }
  __device__ bool has(int k) const { return bits >> k & 1; }
  __device__ int64_t before(int k) const { return start + __popc(bits & ((1u << k) - 1)); }
};

}  // namespace padgs
