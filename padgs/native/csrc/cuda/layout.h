// Where things lie: which tiles a box touches, which chunk a block draws, where a bucket's pixels are kept. Plain
// arithmetic without a GPU in it, for the kernels and for the tests on the host.
#pragma once

#include "../mathematics/boxes.h"
#include "../mathematics/runs.h"

namespace padgs {

constexpr int kChunkPixels = kTile * kTile;
constexpr int kBucket = 32;  // instances of one list that a warp differentiates together, a lane each

// The rows of tiles of an image, and which of them are being drawn. Indices of tiles count from the first drawn row.
struct TileTable {
  int32_t width, height;
  int32_t first_row, end_row;
  const int32_t *level;       // [rows of tiles]
  const int32_t *row_start;   // [rows + 1] tiles before each row of the whole image
  const int64_t *state_start;  // [rows + 1] states before each row of the whole image, backward only
};

// One (Gaussian, tile) pair: whose it is, and the part of the tile that it can reach.
struct Reach {
  int32_t gaussian;
  uint8_t row, row_end, chunk, chunk_end;  // from the tile's corner; chunk_end is exclusive
};
static_assert(sizeof(Reach) == 8, "padgs/render/backends/cuda_tiles.py allocates 2 integers per instance");

PADGS_HD int tiles_before(const TileTable &table, int row) {
  return table.row_start[row] - table.row_start[table.first_row];
}

// How many drawn tiles a box touches.
PADGS_HD uint32_t tiles_of(const PixelBox &box, const TileTable &table) {
  if (box.row == box.row_end) return 0;
  uint32_t total = 0;
  const int end = least((box.row_end - 1) / kTile + 1, table.end_row);
  for (int row = most(box.row / kTile, table.first_row); row < end; ++row) {
    Run runs[2];
    const int pieces = runs_in_row(box, table.level[row], runs);
    for (int r = 0; r < pieces; ++r) total += uint32_t(runs[r].tile_end - runs[r].tile);
  }
  return total;
}

// The n-th of them, row by row, and the part of it that is reached; its gaussian is left out.
PADGS_HD int nth_tile(const PixelBox &box, const TileTable &table, uint32_t n, Reach &reach) {
  for (int row = most(box.row / kTile, table.first_row); row < table.end_row; ++row) {
    Run runs[2];
    const int level = table.level[row], pieces = runs_in_row(box, level, runs);
    for (int r = 0; r < pieces; ++r) {
      const uint32_t here = uint32_t(runs[r].tile_end - runs[r].tile);
      if (n >= here) {
        n -= here;
        continue;
      }
      const int tile = runs[r].tile + int(n), first = tile << level, y0 = row * kTile;
      reach.row = uint8_t(most(box.row - y0, 0));
      reach.row_end = uint8_t(least(box.row_end - y0, kTile));
      reach.chunk = uint8_t(most(runs[r].column - first, 0));
      reach.chunk_end = uint8_t(least(runs[r].column_end - first, 1 << level));
      return tiles_before(table, row) + tile;
    }
  }
  return -1;  // n was not less than tiles_of
}

// The 16x16 pixels that one block draws, counted row by row from the first drawn one.
struct ChunkPlace {
  int row, level;   // of tiles
  int tile, chunk;  // among the drawn tiles; within its tile
  int x0, y0;       // pixels
};
PADGS_HD int64_t chunks_drawn(const TileTable &table) {
  return int64_t(table.end_row - table.first_row) * chunks(table.width);
}
PADGS_HD ChunkPlace chunk_place(const TileTable &table, int64_t block) {
  const int across = chunks(table.width), row = table.first_row + int(block / across), column = int(block % across);
  const int level = table.level[row];
  return {row,
          level,
          tiles_before(table, row) + (column >> level),
          column & ((1 << level) - 1),
          column * kTile,
          row * kTile};
}

// Buckets of a tile's list, numbered without gaps within a tile and at most one gap between tiles: no sum over tiles is
// needed to say where a tile's buckets begin. start: where its instances begin.
PADGS_HD int64_t first_bucket(int64_t start, int64_t tile) { return start / kBucket + tile; }
PADGS_HD int64_t buckets_at_most(int64_t instances, int64_t tiles) { return instances / kBucket + tiles; }

// The tile whose buckets begin last at or before this one.
PADGS_HD int tile_of_bucket(const int32_t *tile_start, int tiles, int64_t bucket) {
  int low = 0, high = tiles;  // tile 0 begins at bucket 0
  while (high - low > 1) {
    const int middle = (low + high) / 2;
    if (first_bucket(tile_start[middle], middle) <= bucket)
      low = middle;
    else
      high = middle;
  }
  return low;
}
PADGS_HD int row_of_tile(const TileTable &table, int tile) {
  int low = table.first_row, high = table.end_row;
  while (high - low > 1) {
    const int middle = (low + high) / 2;
    if (tiles_before(table, middle) <= tile)
      low = middle;
    else
      high = middle;
  }
  return low;
}

// Where the states of a chunk's 256 pixels behind one bucket are kept, in units of 256. A row of level l has 2^l for
// each of its buckets.
PADGS_HD int64_t state_index(const TileTable &table, const int32_t *tile_start, int row, int64_t bucket, int chunk) {
  const int first = tiles_before(table, row);
  const int64_t in_row = bucket - first_bucket(tile_start[first], first);
  return table.state_start[row] - table.state_start[table.first_row] + (in_row << table.level[row]) + chunk;
}

// The first of sorted keys that is not less.
PADGS_HD int64_t lower_bound(const uint32_t *keys, int64_t count, uint32_t key) {
  int64_t low = 0;
  while (count > 0) {
    const int64_t half = count / 2;
    if (keys[low + half] < key) {
      low += half + 1;
      count -= half + 1;
    } else {
      count = half;
    }
  }
  return low;
}

}  // namespace padgs
