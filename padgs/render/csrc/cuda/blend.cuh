// What both directions of blending share: a chunk of 16x16 pixels is a block of 256 threads, a warp is two rows of it.
#pragma once

#include "arguments.h"
#include "device.cuh"
#include "pair.h"

namespace padgs {

constexpr int kBatch = kChunkPixels;  // instances that a block reads at a time, one a thread

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
  int32_t position[kBatch];  // 1 + where it stands in its tile's list
  uint8_t row[kBatch], row_end[kBatch];
};

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

}  // namespace padgs
