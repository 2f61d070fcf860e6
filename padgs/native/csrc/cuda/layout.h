// Where things lie: which tiles a box touches, which pixels a thread draws. Plain arithmetic without a GPU in it, for the
// kernels and for the tests on the host.
#pragma once

#include "../mathematics/boxes.h"
#include "../mathematics/runs.h"

namespace padgs {

constexpr int kTileShift = 4, kTilePixels = kTile * kTile;
static_assert(1 << kTileShift == kTile, "");
constexpr int kPartWidth = 8, kPartHeight = 4;  // the part of a tile that a warp draws, a lane a pixel

// An image of tiles of 16x16 pixels, also near the poles: a wide tile would need several blocks. And which rows of it are
// being drawn; indices of tiles count from the first of them.
struct TileTable {
  int32_t width, height;
  int32_t first_row, end_row;
};

// One (Gaussian, tile) pair: whose it is, and the pixels of the tile that it can reach.
struct alignas(8) Reach {
  int32_t gaussian;
  uint8_t row, row_end, column, column_end;  // from the tile's corner; ends are exclusive
};
static_assert(sizeof(Reach) == 8, "padgs/render/backends/cuda.py allocates 2 integers per instance");

PADGS_HD int runs_in_row(const PixelBox &box, Run *runs) {
  return runs_in_row(box.column, box.column_end, box.second_end, kTileShift, runs);
}

// How many tiles a box touches in each row of tiles that it reaches.
PADGS_HD uint32_t tiles_in_row(const PixelBox &box) {
  Run runs[2];
  uint32_t total = 0;
  const int pieces = runs_in_row(box, runs);
  for (int r = 0; r < pieces; ++r) total += uint32_t(runs[r].tile_end - runs[r].tile);
  return total;
}

// How many drawn tiles a box touches.
PADGS_HD uint32_t tiles_of(const PixelBox &box, const TileTable &table) {
  if (box.row == box.row_end) return 0;
  const int first = most(box.row / kTile, table.first_row), end = least((box.row_end - 1) / kTile + 1, table.end_row);
  return end > first ? uint32_t(end - first) * tiles_in_row(box) : 0;
}

// The n-th of them, row by row, and the part of it that is reached; its gaussian is left out.
PADGS_HD int nth_tile(const PixelBox &box, const TileTable &table, uint32_t n, Reach &reach) {
  Run runs[2];
  runs_in_row(box, runs);
  const uint32_t in_row = tiles_in_row(box), in_first = uint32_t(runs[0].tile_end - runs[0].tile);
  const int row = most(box.row / kTile, table.first_row) + int(n / in_row), y0 = row * kTile;
  const uint32_t place = n % in_row;
  const Run &run = place < in_first ? runs[0] : runs[1];
  const int tile = run.tile + int(place < in_first ? place : place - in_first), x0 = tile * kTile;
  reach.row = uint8_t(most(box.row - y0, 0));
  reach.row_end = uint8_t(least(box.row_end - y0, kTile));
  reach.column = uint8_t(most(run.column - x0, 0));
  reach.column_end = uint8_t(least(run.column_end - x0, kTile));
  return (row - table.first_row) * chunks(table.width) + tile;
}

PADGS_HD int64_t tiles_drawn(const TileTable &table) {
  return int64_t(table.end_row - table.first_row) * chunks(table.width);
}

// The pixel of a thread of the block that draws a tile, and the part of the tile that its warp draws.
struct PixelPlace {
  int column, row;  // of the part's corner, from the tile's
  int x, y;         // in the image
  bool inside;
  int64_t index;
};
PADGS_HD PixelPlace pixel_place(const TileTable &table, int tile, int thread) {
  const int across = chunks(table.width), part = thread / (kPartWidth * kPartHeight);
  const int pixel = thread % (kPartWidth * kPartHeight);
  PixelPlace p;
  p.column = part % (kTile / kPartWidth) * kPartWidth;
  p.row = part / (kTile / kPartWidth) * kPartHeight;
  p.x = tile % across * kTile + p.column + pixel % kPartWidth;
  p.y = (table.first_row + tile / across) * kTile + p.row + pixel / kPartWidth;
  p.inside = p.x < table.width && p.y < table.height;
  p.index = int64_t(p.y) * table.width + p.x;
  return p;
}

// Whether an instance reaches any pixel of a warp's part of its tile.
PADGS_HD bool reaches_part(const Reach &reach, const PixelPlace &p) {
  return reach.row < p.row + kPartHeight && p.row < reach.row_end && reach.column < p.column + kPartWidth &&
         p.column < reach.column_end;
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
