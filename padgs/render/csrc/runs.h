// Which tiles of a row a footprint touches: the same answer for counting, binning, and every backend.
#pragma once

#include "abi.h"
#include "scalar.h"

namespace padgs {

PADGS_HD int chunks(int width) { return (width + kTile - 1) / kTile; }

// A run of tiles in one row, and the chunks [first, end) of the image that the footprint reaches there.
struct Run {
  int tile, tile_end, chunk, chunk_end;
};

// The tiles of one row of level `level` that a box touches: one run, or two across the seam; each tile once.
PADGS_HD int runs_in_row(const PixelBox &box, int level, Run *runs) {
  const int chunk = box.column / kTile, chunk_end = chunks(box.column_end);
  runs[0] = {chunk >> level, ((chunk_end - 1) >> level) + 1, chunk, chunk_end};
  if (box.second_end == 0) return 1;
  const int second_end = chunks(box.second_end), second_tiles = ((second_end - 1) >> level) + 1;
  if (second_tiles > runs[0].tile) {  // both pieces meet in a tile: take it, and with it the whole row, once
    runs[0] = {0, runs[0].tile_end, 0, chunk_end};
    return 1;
  }
  runs[1] = {0, second_tiles, 0, second_end};
  return 2;
}

}  // namespace padgs
