// The tiles of an image as blending visits them, and their patches: 8 x 2 pixels, one for each vector lane.
#pragma once

#include <algorithm>

#include "../abi.h"
#include "simd.h"

namespace padgs {
namespace PADGS_ISA {

static_assert(kPatchWidth * kPatchHeight == kLanes, "a patch is a vector");

// One tile's place in the image.
struct Tile {
  int x0, y0, columns, rows;        // pixels
  int patch_columns, patch_rows;
  int64_t first, end;  // its instances

  int patches() const { return patch_columns * patch_rows; }
};

inline Tile tile_at(const BlendArguments &args, int row, int64_t index) {
  const TileGrid &grid = args.grid;
  const int level = grid.level[row], y0 = row * kTile;
  const int x0 = int(index - grid.row_start[row - grid.first_row]) * (kTile << level);
  const int columns = std::min(kTile << level, grid.width - x0), rows = std::min(kTile, grid.height - y0);
  return {x0,
          y0,
          columns,
          rows,
          (columns + kPatchWidth - 1) / kPatchWidth,
          (rows + kPatchHeight - 1) / kPatchHeight,
          args.tile_start[index],
          args.tile_start[index + 1]};
}

// One patch of a tile; patches are numbered row by row. What lies beyond the image is in no pixel.
struct Patch {
  int x0, y0, columns, rows;  // pixels inside the image
  int width;                  // of the image

  Patch(const Tile &tile, int index, int image_width)
      : x0(tile.x0 + index % tile.patch_columns * kPatchWidth), y0(tile.y0 + index / tile.patch_columns * kPatchHeight),
        columns(std::min(kPatchWidth, tile.x0 + tile.columns - x0)),
        rows(std::min(kPatchHeight, tile.y0 + tile.rows - y0)), width(image_width) {}

  // Calls visit(lane, pixel) for each pixel inside the image.
  template <typename Visit>
  void each_pixel(Visit visit) const {
    for (int y = 0; y < rows; ++y)
      for (int x = 0; x < columns; ++x) visit(y * kPatchWidth + x, int64_t(y0 + y) * width + x0 + x);
  }
  // 1 inside the image, -1 outside.
  Vec inside() const {
    float lanes[kLanes];
    std::fill_n(lanes, kLanes, -1.0f);
    each_pixel([&](int lane, int64_t) { lanes[lane] = 1; });
    return load(lanes);
  }
};

// Calls visit(p) for each patch of a tile that an instance can reach, row by row. In one loop, because the ends of rows are
// hard to predict.
template <typename Visit>
PADGS_INLINE void for_each_patch(const Tile &tile, const Instance &instance, Visit visit) {
  const int columns = instance.column_end - instance.column, to_next_row = tile.patch_columns - columns + 1;
  const int end = (instance.row_end - 1) * tile.patch_columns + instance.column_end;
  int left = columns;  // in this row
  for (int p = instance.row * tile.patch_columns + instance.column; p < end;) {
    visit(p);
    --left;
    p += left ? 1 : to_next_row;
    left = left ? left : columns;
  }
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

// Footprints are scattered in memory; ask for those of the instances to come. Inlined always, because GCC takes a
// function that only prefetches for one without effect and drops its calls.
constexpr int kAhead = 16;
PADGS_INLINE void prefetch(const BlendArguments &args, int64_t instance, int64_t end) {
  if (instance < end) __builtin_prefetch(args.footprints + args.instances[instance].gaussian);
}
// And for the slots of the gradient sums, which the stores would wait for.
PADGS_INLINE void prefetch(const BlendGradientArguments &args, int64_t instance, int64_t first, int64_t end) {
  if (instance < first || instance >= end) return;
  const Instance &ahead = args.forward.instances[instance];
  __builtin_prefetch(args.forward.footprints + ahead.gaussian);
  __builtin_prefetch(args.gradient_sums + int64_t(ahead.slot) * kGradientSums, 1);
}

}  // namespace PADGS_ISA
}  // namespace padgs
