// Which tiles of a row a footprint touches: the same answer for counting, binning, and every backend.
#pragma once

#include <cmath>

#include "../abi.h"
#include "scalar.h"

namespace padgs {

PADGS_HD int units(int pixels, int size) { return (pixels + size - 1) / size; }
PADGS_HD int chunks(int width) { return units(width, kTile); }

// How wide the tiles of a row are, 2^level chunks, so that a tile covers about the same angle at every latitude:
// level = round(log2(1 / cos)).
inline int tile_level(const Camera &camera, int row) {
  if (camera.model != kPanoramaModel || camera.square) return 0;
  const double latitude = ((row + 0.5) * kTile / camera.height - 0.5) * 3.14159265358979323846;
  const int wanted = int(std::lround(std::log2(1 / std::fmax(std::cos(latitude), 1e-3))));
  int level = 0;
  while (level < wanted && level < kMaxLevel && (2 << level) <= chunks(camera.width)) ++level;
  return level;
}

// A run of tiles in one row, and the columns [column, column_end) of the image that the footprint reaches there.
struct Run {
  int tile, tile_end, column, column_end;
};

// The tiles of one row that a box touches: one run, or two across the seam; each tile once. Columns are counted in any
// unit of which a tile has 2^shift.
PADGS_HD int runs_in_row(int column, int column_end, int second_end, int shift, Run *runs) {
  runs[0] = {column >> shift, ((column_end - 1) >> shift) + 1, column, column_end};
  if (second_end == 0) return 1;
  runs[1] = {0, ((second_end - 1) >> shift) + 1, 0, second_end};
  if (runs[1].tile_end <= runs[0].tile) return 2;
  runs[0].tile = runs[0].column = 0;  // both pieces meet in a tile: take it, and with it the whole row, once
  return 1;
}

}  // namespace padgs
