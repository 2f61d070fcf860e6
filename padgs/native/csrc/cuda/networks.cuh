// The decoder's three networks w2 relu(w1 x + b1) + b2 on tensor cores, sixteen anchors a warp. Factors are rounded to a
// reduced type, hidden units and outputs are rounded once, as padgs/methods/anchors/native_decoder.py defines it. Hidden units never
// leave their warp: sums of one product are the factor of the next.
#pragma once

#include <algorithm>

#include "decode.cuh"
#include "mma.cuh"

namespace padgs {

constexpr int kWarps = 4, kThreads = kWarps * kWarp;  // of a block
constexpr int kRows = 16;                             // anchors of a warp
// Capacities; unused places hold zeros. padgs/methods/anchors/native_decoder.py calls `padgs_cuda_networks_fit`.
constexpr int kMostInputs = 48;  // with a 1, whose weight is the bias
constexpr int kMostFeatures = 32, kMostHidden = 32, kMostOffsets = 10;
constexpr int kHiddenTiles = kMostHidden / 8;

// Number of outputs in a part of a network.
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

// All threads of the block, before a barrier; `number(row, column)` is the value.
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

// The anchors of a warp, at most sixteen.
struct Anchors {
  int64_t first;
  int count;

  __device__ Anchors(int64_t tile, int64_t all) : first((tile * kWarps + threadIdx.x / kWarp) * kRows) {
    const int64_t left = all - first;
    count = left < 0 ? 0 : left < kRows ? int(left) : kRows;
  }
  // Of those in whose rows the lane has numbers, one of the first or of the second eight; -1 where there is none.
  __device__ int64_t of(int half) const {
    const int row = 8 * half + lane_index() / 4;
    return row < count ? first + row : -1;
  }
};

// Limit of blocks, because each prepares the weights and writes a gradient of all of them. The number depends on
// nothing else, so that each block adds up the same on every GPU; torch
// adds the blocks, in an order that is the same on GPUs of one model.
constexpr int64_t kMostBlocks = 512;
inline int64_t blocks_of_anchors(int64_t anchors) { return std::min(blocks_for(anchors, kWarps * kRows), kMostBlocks); }

// Input `column` of an anchor, and 1 behind the last.
__device__ inline float input(const NetworkInputs &in, int64_t anchor, int column, int count) {
  const float *features = in.features + anchor * in.feature_count;
  const float *seen = in.seen + anchor * (count - in.feature_count) - in.feature_count;
  if (column >= count) return column == count ? 1.0f : 0.0f;
  return (column < in.feature_count ? features : seen)[column];
}

template <class T>
struct InputRows {
  FragmentA steps[kMostInputs / 16];

  __device__ InputRows(const NetworkInputs &in, const Anchors &anchors, int count) {
    for (int step = 0; step < kMostInputs / 16; ++step) {
      for (int i = 0; i < 4; ++i) {
        const int column = 16 * step + i / 2 * 8 + 2 * (lane_index() % 4);
        const int64_t anchor = anchors.of(i % 2);
        steps[step].pairs[i] = anchor < 0 ? 0 : packed(input(in, anchor, column, count),
                                                       input(in, anchor, column + 1, count), T{});
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

// Visits the Gaussians of a warp's anchors, a lane each, with (row of the anchor, k, whether it is selected, how many
// selected ones are before it). All lanes of the warp have to come along.
template <class Visit>
__device__ void each_gaussian(const DecodeArguments &args, const Anchors &anchors, Visit visit) {
  const int count = anchors.count * args.offsets;
  int64_t before = count ? args.slot_start[anchors.first] : 0;
  for (int i = lane_index(); i - lane_index() < count; i += kWarp) {
    const bool selected = i < count && args.raw_opacities[anchors.first * args.offsets + i] > 0;
    const unsigned all = __ballot_sync(kAllLanes, selected), lower = (1u << lane_index()) - 1;
    if (i < count) visit(i / args.offsets, i % args.offsets, selected, before + __popc(all & lower));
    before += __popc(all);
  }
}

}  // namespace padgs
