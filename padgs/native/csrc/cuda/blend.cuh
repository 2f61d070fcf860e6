// What both directions of blending share: a chunk of 16x16 pixels is a block of 256 threads, a warp is two rows of it.
#pragma once

#include "arguments.h"
#include "device.cuh"
#include "pair.h"

namespace padgs {

constexpr int kBatch = kChunkPixels;  // instances that a block reads at a time, one a thread
constexpr int kBucketThreads = 128;   // where a warp takes a bucket

// The pixel of one thread.
struct PixelPlace {
  ChunkPlace chunk;
  int x, y;  // in the image
  bool inside;
  int64_t index;
};
__device__ inline PixelPlace pixel_place(const TileTable &table, int64_t block, int thread) {
  PixelPlace p;
  p.chunk = chunk_place(table, block);
  p.x = p.chunk.x0 + thread % kTile;
  p.y = p.chunk.y0 + thread / kTile;
  p.inside = p.x < table.width && p.y < table.height;
  p.index = int64_t(p.y) * table.width + p.x;
  return p;
}

// Instances in shared memory.
struct Batch {
  Footprint footprints[kBatch];
  Reach reaches[kBatch];
  int32_t position[kBatch];  // 1 + where it stands in its tile's list
  int32_t counts[kBatch / kWarp];
};

// How many threads of lower rank have `chosen`, and how many all have.
__device__ inline int rank_in_block(bool chosen, int *counts, int &total) {
  const unsigned votes = __ballot_sync(kAllLanes, chosen);
  const int warp = int(threadIdx.x) / kWarp;
  if (lane_index() == 0) counts[warp] = __popc(votes);
  __syncthreads();
  int rank = __popc(votes & ((1u << lane_index()) - 1));
  total = 0;
  for (int w = 0; w < kBatch / kWarp; ++w) {
    rank += w < warp ? counts[w] : 0;
    total += counts[w];
  }
  return rank;
}

// Reads the instances from `first` on, and keeps those that reach the block's chunk; returns how many. The whole block
// takes part, and nobody may read the batch before any more.
__device__ inline int fill(Batch &batch, const BlendInputs &args, const ChunkPlace &place, int begin, int first,
                           int end) {
  const int at = first + int(threadIdx.x);
  Reach reach{};
  bool chosen = at < end;
  if (chosen) {
    reach = args.reaches[args.slots[at]];
    chosen = reach.chunk <= place.chunk && place.chunk < reach.chunk_end;
  }
  int total;
  const int rank = rank_in_block(chosen, batch.counts, total);
  if (chosen) {
    batch.footprints[rank] = args.footprints[reach.gaussian];
    batch.reaches[rank] = reach;
    batch.position[rank] = at - begin + 1;
  }
  __syncthreads();
  return total;
}

// Adds up what the threads of a block counted.
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

// The instance that a lane differentiates, and the bucket of its warp.
struct BucketLane {
  int64_t bucket;
  int tile, row, level, column;  // row of tiles; first column of chunks
  int from, at;                  // in the tile's list: the first of the bucket, and this lane's own
  bool mine;                     // false behind the end of the list
  int32_t slot;
  Reach reach;
  Footprint footprint;
};

// False, for whole warps, where there is no such bucket.
__device__ inline bool take_bucket(const BlendInputs &args, int64_t instances, int tiles, BucketLane &lane) {
  const TileTable &table = args.table;
  lane.bucket = global_thread() / kWarp;
  if (lane.bucket >= buckets_at_most(instances, tiles)) return false;
  lane.tile = tile_of_bucket(args.tile_start, tiles, lane.bucket);
  const int begin = args.tile_start[lane.tile], count = args.tile_start[lane.tile + 1] - begin;
  const int64_t from = (lane.bucket - first_bucket(begin, lane.tile)) * kBucket;
  if (from >= count) return false;
  lane.row = row_of_tile(table, lane.tile), lane.level = table.level[lane.row];
  lane.column = (lane.tile - tiles_before(table, lane.row)) << lane.level;
  lane.from = int(from), lane.at = lane.from + lane_index();
  lane.mine = lane.at < count;
  lane.slot = 0, lane.reach = Reach{}, lane.footprint = Footprint{};
  if (lane.mine) {
    lane.slot = args.slots[begin + lane.at];
    lane.reach = args.reaches[lane.slot];
    lane.footprint = args.footprints[lane.reach.gaussian];
  }
  return true;
}

// Rows of a chunk [top, bottom) that active lanes of a warp reach; bottom < top where none is.
__device__ inline void rows_of_warp(bool active, const Reach &reach, int &top, int &bottom) {
  top = -warp_max(active ? -int(reach.row) : -kTile), bottom = warp_max(active ? int(reach.row_end) : 0);
}

// dL by a pixel's colour, and by what it leaves for the background.
__device__ inline float load_upstream(const BlendGradientInputs &args, int64_t p, Upstream &upstream) {
  const float *grad = args.grad_image + 3 * p, *background = args.forward.background;
  upstream = {grad[0], grad[1], grad[2], 0.0f};
  const float grad_t = args.grad_transmittance ? args.grad_transmittance[p] : 0.0f;
  return grad_t + (grad[0] * background[0] + grad[1] * background[1] + grad[2] * background[2]);
}

inline int64_t blocks_of(const TileTable &table) { return chunks_drawn(table); }

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

__device__ inline void write_ray_gradient(const BlendGradientInputs &args, const PixelPlace &place,
                                          Vec3<float> gradient) {
  const int64_t stride = int64_t(chunks(args.forward.table.width)) * kTile;
  float *out = args.grad_rays + 3 * stride * place.y + place.x;
  out[0] = gradient.x, out[stride] = gradient.y, out[2 * stride] = gradient.z;
}

// Hybrid blending, hybrid.cu and hybrid_backward.cu: as padgs_cuda_blend, and all but the sum over slots.
void hybrid_forward(const Queue &queue, const BlendInputs &args);
void hybrid_backward(const Queue &queue, const BlendGradientInputs &args, int tiles);

}  // namespace padgs
