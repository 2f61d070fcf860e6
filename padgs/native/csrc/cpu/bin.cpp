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

// The patches that a Gaussian can reach: a pixel box in other units.
struct PatchBox {
  uint16_t column, column_end, second_end, row, row_end;

  explicit PatchBox(const PixelBox &box)
      : column(uint16_t(box.column / kPatchWidth)),
        column_end(uint16_t(units(box.column_end, kPatchWidth))),
        second_end(uint16_t(units(box.second_end, kPatchWidth))), row(uint16_t(box.row / kPatchHeight)),
        row_end(uint16_t(units(box.row_end, kPatchHeight))) {}
};

constexpr int kPatchRows = kTile / kPatchHeight;  // of a tile

// An instance before it is known where in the list of its tile it comes. Its four bytes of patches are put together in a
// register: reading a word right after writing its bytes would wait for all of them.
struct Listed {
  int32_t gaussian;
  uint32_t tile;
  uint32_t patches;

  static uint32_t packed(int row, int row_end, int column, int column_end) {
    return uint32_t(row) | uint32_t(row_end) << 8 | uint32_t(column) << 16 | uint32_t(column_end) << 24;
  }
  Instance at(uint32_t slot) const {
    return {gaussian, slot, uint8_t(patches), uint8_t(patches >> 8), uint8_t(patches >> 16), uint8_t(patches >> 24)};
  }
};

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
      for_each_run(PatchBox(boxes[i]), grid,
                   [&](int row, const Run &run) { per_row[row] += run.tile_end - run.tile; });
}

// Fills the lists of the grid's drawn tiles.
//   slot_start [N + 1]: where each Gaussian's gradient sums begin; its instances are consecutive there
//   tile_start [tiles + 1], instances [I]
PADGS_API void padgs_bin(const PixelBox *boxes, int64_t count, const int32_t *order, int64_t visible,
                         const TileGrid *grid, int64_t *slot_start, int64_t *tile_start, Instance *instances) {
  const int64_t tiles = grid->row_start[grid->end_row - grid->first_row];
  std::fill_n(slot_start, count + 1, int64_t(0));
  // Each thread takes a block of the Gaussians, in depth order, and has a histogram of its own. Counting sort is
  // stable, so that the lists do not depend on how many blocks there are. Which tiles a box touches is worked out once:
  // the lengths of its loops are hard to predict.
  const int blocks = threads();
  const auto start = [&](int64_t block) { return visible * block / blocks; };
  std::vector<int64_t> next(blocks * tiles, 0);
  std::vector<std::vector<Listed>> listed(blocks);
#pragma omp parallel for schedule(static, 1)
  for (int block = 0; block < blocks; ++block) {
    int64_t *histogram = next.data() + block * tiles;
    std::vector<Listed> &own = listed[block];
    own.reserve(2 * (start(block + 1) - start(block)));
    for (int64_t i = start(block); i < start(block + 1); ++i) {
      if (i + kAhead < visible) __builtin_prefetch(boxes + order[i + kAhead]);
      const PatchBox box(boxes[order[i]]);
      const size_t before = own.size();
      for_each_run(box, *grid, [&](int row, const Run &run) {
        const int64_t base = grid->row_start[row - grid->first_row];
        const int shift = grid->level[row] + kTileShift, top = row * kPatchRows;
        const int first_row = std::max(box.row - top, 0), end_row = std::min(box.row_end - top, kPatchRows);
        for (int tile = run.tile; tile < run.tile_end; ++tile) {
          const int left = tile << shift;
          const int column = std::max(run.column - left, 0), column_end = std::min(run.column_end - left, 1 << shift);
          own.push_back({order[i], uint32_t(base + tile), Listed::packed(first_row, end_row, column, column_end)});
          ++histogram[base + tile];
        }
      });
      slot_start[order[i] + 1] = int64_t(own.size() - before);
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
    const std::vector<Listed> &own = listed[block];
    int32_t gaussian = -1;
    uint32_t slot = 0;
    for (size_t i = 0; i < own.size(); ++i) {
      if (i + kAhead < own.size()) __builtin_prefetch(slot_start + own[i + kAhead].gaussian);
      slot = own[i].gaussian == gaussian ? slot + 1 : uint32_t(slot_start[own[i].gaussian]);
      gaussian = own[i].gaussian;
      instances[cursor[own[i].tile]++] = own[i].at(slot);
    }
  }
}

// Adds the gradient sums of each Gaussian's instances, in the order of its slots, to its totals [N, kGradientSums].
PADGS_API void padgs_sum_moments(const float *gradient_sums, const int64_t *slot_start, int64_t count, float *totals) {
#pragma omp parallel for schedule(static)
  for (int64_t i = 0; i < count; ++i)
    for (int64_t slot = slot_start[i]; slot < slot_start[i + 1]; ++slot)
      for (int k = 0; k < kGradientSums; ++k) totals[i * kGradientSums + k] += gradient_sums[slot * kGradientSums + k];
}
