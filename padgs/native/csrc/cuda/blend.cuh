// Shared by both passes of blending: a tile is a block of 256 threads, a warp renders 8x4 pixels of it.
#pragma once

#include "arguments.h"
#include "device.cuh"
#include "pair.h"

namespace padgs {

constexpr int kWarps = kTilePixels / kWarp;
constexpr int kBlocks = 4;  // that an SM shall hold at once: half of the threads that it can
static_assert(kPartWidth * kPartHeight == kWarp, "a lane a pixel");

// Instances of one list, in shared memory.
template <int kRoom>
struct Batch {
  static constexpr int kSize = kRoom;
  Footprint footprints[kRoom];
  Reach reaches[kRoom];
};

// Reads `count` instances, starting at position `from` of all lists. The whole block takes part; barriers are needed
// before, so that no thread reads the old batch, and after, before any thread reads this one.
template <int kRoom>
__device__ void fill(Batch<kRoom> &batch, const BlendInputs &args, int from, int count) {
  const int k = int(threadIdx.x);
  if (k >= count) return;
  const Reach reach = args.reaches[args.slots[from + k]];
  batch.reaches[k] = reach;
  batch.footprints[k] = args.footprints[reach.gaussian];
}

// Which of 32 instances from `group` on reach pixels of the warp, a bit each; none from `count` on.
template <int kRoom>
__device__ unsigned reaching(const Batch<kRoom> &batch, int group, int count, const PixelPlace &place) {
  const int k = group + lane_index();
  return __ballot_sync(kAllLanes, k < count && reaches_part(batch.reaches[k], place));
}

// Sums the counts of the threads of a block.
__device__ inline void write_pair_counts(const BlendInputs &args, int evaluated, int contributing) {
  if (!args.pair_counts) return;
  __shared__ int pairs[2];
  const int thread = int(threadIdx.x);
  if (thread < 2) pairs[thread] = 0;
  __syncthreads();
  evaluated = warp_sum(evaluated), contributing = warp_sum(contributing);
  if (lane_index() == 0) atomicAdd(pairs, evaluated), atomicAdd(pairs + 1, contributing);
  __syncthreads();
  if (thread < 2) args.pair_counts[2 * int64_t(blockIdx.x) + thread] = pairs[thread];
}

template <bool kPlanar>
struct PixelOf;
template <>
struct PixelOf<true> {
  typedef PlanarPixel Type;
};
template <>
struct PixelOf<false> {
  typedef ProjectivePixel Type;
};

// A pixel outside the image, which draws nothing, is taken for the first.
template <class Pixel>
__device__ Pixel pixel_at(const BlendInputs &args, const PixelPlace &place) {
  const int x = place.inside ? place.x : 0, y = place.inside ? place.y : 0;
  return {args.rays, args.steepness, args.wrap, args.table.width, x, y};
}

// Hybrid blending, hybrid.cu and hybrid_backward.cu: as padgs_cuda_blend, and all but the sum over slots.
void hybrid_forward(const Queue &queue, const BlendInputs &args);
void hybrid_backward(const Queue &queue, const BlendGradientInputs &args);

}  // namespace padgs
