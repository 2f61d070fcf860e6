// The tiles of an image as blending visits them.
#pragma once

#include <algorithm>

#include "abi.h"

namespace padgs {
namespace PADGS_ISA {

// One tile's place in the image.
struct Tile {
  int x0, y0, chunks, columns, rows;
  int64_t first, end;  // its instances
};

inline Tile tile_at(const BlendArguments &args, int row, int64_t index) {
  const TileGrid &grid = args.grid;
  const int level = grid.level[row], y0 = row * kTile;
  const int x0 = int(index - grid.row_start[row - grid.first_row]) * (kTile << level);
  const int columns = std::min(kTile << level, grid.width - x0);
  return {x0, y0, (columns + kTile - 1) / kTile, columns, std::min(kTile, grid.height - y0), args.tile_start[index],
          args.tile_start[index + 1]};
}

// Calls visit(tile, index) for every drawn tile, several at a time.
template <typename Visit>
void for_each_tile(const BlendArguments &args, Visit visit) {
  const TileGrid &grid = args.grid;
  const int rows = grid.end_row - grid.first_row;
  const int64_t tiles = grid.row_start[rows];
#pragma omp parallel for schedule(dynamic, 1)
  for (int64_t index = 0; index < tiles; ++index) {
    const int64_t *after = std::upper_bound(grid.row_start, grid.row_start + rows + 1, index);
    visit(tile_at(args, grid.first_row + int(after - grid.row_start) - 1, index), index);
  }
}

// Footprints are scattered in memory; ask for those of the instances to come.
constexpr int kAhead = 8;
inline void prefetch(const BlendArguments &args, int64_t instance, int64_t end) {
  if (instance < end) __builtin_prefetch(args.footprints + args.instances[instance].gaussian);
}

}  // namespace PADGS_ISA
}  // namespace padgs
