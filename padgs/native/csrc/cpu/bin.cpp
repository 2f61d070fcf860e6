// Order and tiles: one depth sort of the Gaussians, then a stable counting sort of their tile instances, so that every
// tile's list is front to back without sorting any tile. The result does not depend on the number of threads.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#if defined(_OPENMP)
#include <omp.h>
#endif

#include "../mathematics/runs.h"

namespace padgs {
namespace {

constexpr int kTileShift = 1;  // a tile of level l is 2^(l + kTileShift) patches wide
static_assert(kTile == kPatchWidth << kTileShift, "chosen for patches half as wide as the narrowest tile");
constexpr int64_t kAhead = 16;  // Gaussians to ask for in advance, where they are scattered in memory

// Stable radix sort of the indices of visible Gaussians by depth; positive floats order as their bits do.
std::vector<int32_t> depth_order(const Footprint *footprints, const PixelBox *boxes, int64_t count) {
  constexpr int kBits = 11, kBuckets = 1 << kBits, kPasses = 3;
  struct Item {
    uint32_t key;
    int32_t index;
  };
  std::vector<Item> items, sorted;
  items.reserve(count);
  for (int64_t i = 0; i < count; ++i) {
    if (boxes[i].row == boxes[i].row_end) continue;
    uint32_t key;
    std::memcpy(&key, &footprints[i].depth, sizeof key);
    items.push_back({key, int32_t(i)});
  }
  sorted.resize(items.size());
  for (int pass = 0; pass < kPasses; ++pass) {
    const int shift = pass * kBits;
    int64_t start[kBuckets + 1] = {};
    for (const Item &item : items) ++start[(item.key >> shift & (kBuckets - 1)) + 1];
    for (int b = 0; b < kBuckets; ++b) start[b + 1] += start[b];
    for (const Item &item : items) sorted[start[item.key >> shift & (kBuckets - 1)]++] = item;
    items.swap(sorted);
  }
  std::vector<int32_t> order(items.size());
  for (size_t i = 0; i < items.size(); ++i) order[i] = items[i].index;
  return order;
}

// The patches that a Gaussian can reach: a pixel box in other units, as the passes over all instances read it.
struct PatchBox {
  int32_t gaussian;
  uint16_t column, column_end, second_end, row, row_end;

  PatchBox(const PixelBox &box, int32_t index)
      : gaussian(index),
        column(uint16_t(box.column / kPatchWidth)),
        column_end(uint16_t(units(box.column_end, kPatchWidth))),
        second_end(uint16_t(units(box.second_end, kPatchWidth))), row(uint16_t(box.row / kPatchHeight)),
        row_end(uint16_t(units(box.row_end, kPatchHeight))) {}
};

constexpr int kPatchRows = kTile / kPatchHeight;  // of a tile

// Calls visit(row, run) for each run of drawn tiles of a box, in a fixed order.
template <typename Visit>
inline void for_each_run(const PatchBox &box, const TileGrid &grid, Visit visit) {
  const int end = std::min((box.row_end - 1) / kPatchRows + 1, grid.end_row);
  for (int row = std::max(box.row / kPatchRows, grid.first_row); row < end; ++row) {
    Run runs[2];
    const int count = runs_in_row(box.column, box.column_end, box.second_end, grid.level[row] + kTileShift, runs);
    for (int r = 0; r < count; ++r) visit(row, runs[r]);
  }
}

int threads() {
#ifdef _OPENMP
  return omp_get_max_threads();
#else
  return 1;
#endif
}

}  // namespace
}  // namespace padgs

using namespace padgs;

PADGS_API void padgs_tile_levels(const Camera *camera, int32_t *level) {
  for (int row = 0; row < chunks(camera->height); ++row) level[row] = tile_level(*camera, row);
}

// Depth order [visible] of the Gaussians; returns how many are visible.
PADGS_API int64_t padgs_depth_order(const Footprint *footprints, const PixelBox *boxes, int64_t count, int32_t *order) {
  const std::vector<int32_t> sorted = depth_order(footprints, boxes, count);
  std::copy(sorted.begin(), sorted.end(), order);
  return int64_t(sorted.size());
}

// Instances in each row of tiles, [rows]: known before anything of their size is allocated.
PADGS_API void padgs_count_instances(const PixelBox *boxes, int64_t count, const int32_t *level, int32_t rows,
                                     int64_t *per_row) {
  std::fill_n(per_row, rows, int64_t(0));
  const TileGrid grid{0, 0, 0, rows, level, nullptr};
  for (int64_t i = 0; i < count; ++i)
    if (boxes[i].row < boxes[i].row_end)
      for_each_run(PatchBox(boxes[i], int32_t(i)), grid,
                   [&](int row, const Run &run) { per_row[row] += run.tile_end - run.tile; });
}

// Fills the lists of the grid's drawn tiles.
//   slot_start [N + 1]: where each Gaussian's moments begin; its instances are consecutive there
//   tile_start [tiles + 1], instances [I]
PADGS_API void padgs_bin(const PixelBox *boxes, int64_t count, const int32_t *order, int64_t visible,
                         const TileGrid *grid, int64_t *slot_start, int64_t *tile_start, Instance *instances) {
  const int64_t tiles = grid->row_start[grid->end_row - grid->first_row];
  std::fill_n(slot_start, count + 1, int64_t(0));
  // Each thread takes a block of the Gaussians, in depth order, and has a histogram of its own. Counting sort is
  // stable, so that the lists do not depend on how many blocks there are.
  const int blocks = threads();
  const auto start = [&](int64_t block) { return visible * block / blocks; };
  std::vector<int64_t> next(blocks * tiles, 0);
  std::vector<std::vector<PatchBox>> sorted(blocks);
#pragma omp parallel for schedule(static, 1)
  for (int block = 0; block < blocks; ++block) {
    int64_t *histogram = next.data() + block * tiles;
    sorted[block].reserve(start(block + 1) - start(block));
    for (int64_t i = start(block); i < start(block + 1); ++i) {
      if (i + kAhead < visible) __builtin_prefetch(boxes + order[i + kAhead]);
      sorted[block].emplace_back(boxes[order[i]], order[i]);
      int64_t own = 0;
      for_each_run(sorted[block].back(), *grid, [&](int row, const Run &run) {
        int64_t *tile = histogram + grid->row_start[row - grid->first_row];
        for (int t = run.tile; t < run.tile_end; ++t) ++tile[t];
        own += run.tile_end - run.tile;
      });
      slot_start[order[i] + 1] = own;
    }
  }
  for (int64_t i = 0; i < count; ++i) slot_start[i + 1] += slot_start[i];
  int64_t total = 0;
  for (int64_t tile = 0; tile < tiles; ++tile) {
    tile_start[tile] = total;
    for (int block = 0; block < blocks; ++block) {
      const int64_t here = next[block * tiles + tile];
      next[block * tiles + tile] = total;
      total += here;
    }
  }
  tile_start[tiles] = total;
#pragma omp parallel for schedule(static, 1)
  for (int block = 0; block < blocks; ++block) {
    int64_t *cursor = next.data() + block * tiles;
    const std::vector<PatchBox> &own = sorted[block];
    for (size_t i = 0; i < own.size(); ++i) {
      if (i + kAhead < own.size()) __builtin_prefetch(slot_start + own[i + kAhead].gaussian);
      const PatchBox &box = own[i];
      Instance part{box.gaussian, uint32_t(slot_start[box.gaussian]), 0, 0, 0, 0};
      for_each_run(box, *grid, [&](int row, const Run &run) {
        const int64_t base = grid->row_start[row - grid->first_row];
        const int shift = grid->level[row] + kTileShift, top = row * kPatchRows;
        part.row = uint8_t(std::max(box.row - top, 0));
        part.row_end = uint8_t(std::min(box.row_end - top, kPatchRows));
        for (int tile = run.tile; tile < run.tile_end; ++tile) {
          const int first = tile << shift;
          part.column = uint8_t(std::max(run.column - first, 0));
          part.column_end = uint8_t(std::min(run.column_end - first, 1 << shift));
          instances[cursor[base + tile]++] = part;
          ++part.slot;
        }
      });
    }
  }
}

// Adds the moments of each Gaussian's instances, in the order of its slots, to its totals [N, kMoments].
PADGS_API void padgs_sum_moments(const float *moments, const int64_t *slot_start, int64_t count, float *totals) {
#pragma omp parallel for schedule(static)
  for (int64_t i = 0; i < count; ++i)
    for (int64_t slot = slot_start[i]; slot < slot_start[i + 1]; ++slot)
      for (int k = 0; k < kMoments; ++k) totals[i * kMoments + k] += moments[slot * kMoments + k];
}
