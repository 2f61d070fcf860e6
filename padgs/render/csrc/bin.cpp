// Order and tiles: one depth sort of the Gaussians, then a stable counting sort of their tile instances, so that every
// tile's list is front to back without sorting any tile. The result does not depend on the number of threads.
#include <algorithm>
#include <cstring>
#include <vector>

#include "abi.h"

namespace padgs {
namespace {

// Stable radix sort of the indices of visible Gaussians by depth; positive floats order as their bits do.
void sort_by_depth(const Footprint *footprints, const TileBox *boxes, int64_t count, std::vector<int32_t> &order) {
  constexpr int kBits = 11, kBuckets = 1 << kBits, kPasses = 3;
  struct Item {
    uint32_t key;
    int32_t index;
  };
  std::vector<Item> items, sorted;
  items.reserve(count);
  for (int64_t i = 0; i < count; ++i) {
    if (boxes[i].count() == 0) continue;
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
  order.resize(items.size());
  for (size_t i = 0; i < items.size(); ++i) order[i] = items[i].index;
}

// Calls visit(tile) for each tile of the box inside rows [first, end), in a fixed order.
template <typename Visit>
void for_each_tile(const TileBox &box, int first, int end, int per_row, Visit visit) {
  for (int row = std::max(box.row, first); row < std::min(box.row_end, end); ++row) {
    const int64_t base = int64_t(row - first) * per_row;
    for (int column = box.column; column < box.column_end; ++column) visit(base + column);
    for (int column = 0; column < box.second_end; ++column) visit(base + column);
  }
}

}  // namespace
}  // namespace padgs

using namespace padgs;

// Depth order [visible] of the Gaussians; returns how many are visible.
PADGS_API int64_t padgs_depth_order(const Footprint *footprints, const TileBox *boxes, int64_t count, int32_t *order) {
  std::vector<int32_t> sorted;
  sort_by_depth(footprints, boxes, count, sorted);
  std::copy(sorted.begin(), sorted.end(), order);
  return int64_t(sorted.size());
}

// Instances in each row of tiles, [tile rows]: known before anything of their size is allocated.
PADGS_API void padgs_count_instances(const TileBox *boxes, int64_t count, int32_t tile_rows, int64_t *per_row) {
  std::fill_n(per_row, tile_rows, int64_t(0));
  for (int64_t i = 0; i < count; ++i)
    for (int row = boxes[i].row; row < boxes[i].row_end; ++row)
      per_row[row] += boxes[i].column_end - boxes[i].column + boxes[i].second_end;
}

// Fills the tile lists of tile rows [first, end).
//   slot_start [N + 1]: where each Gaussian's moments begin; its instances are consecutive there
//   tile_start [tiles + 1], instances [I], slots [I]
PADGS_API void padgs_bin(const TileBox *boxes, int64_t count, const int32_t *order, int64_t visible, int32_t per_row,
                         int32_t first, int32_t end, int64_t *slot_start, int64_t *tile_start, int32_t *instances,
                         int64_t *slots) {
  const int64_t tiles = int64_t(end - first) * per_row;
  slot_start[0] = 0;
  for (int64_t i = 0; i < count; ++i) {
    const TileBox &box = boxes[i];
    const int rows = std::max(0, std::min(box.row_end, end) - std::max(box.row, first));
    slot_start[i + 1] = slot_start[i] + int64_t(rows) * (box.column_end - box.column + box.second_end);
  }
  // Each block of Gaussians, in depth order, has its own histogram: blocks can be filled at the same time.
  const int64_t block_size = std::max<int64_t>(4096, (visible + 63) / 64);
  const int64_t blocks = (visible + block_size - 1) / block_size;
  std::vector<int64_t> next(blocks * tiles, 0);
#pragma omp parallel for schedule(static, 1)
  for (int64_t block = 0; block < blocks; ++block) {
    int64_t *histogram = next.data() + block * tiles;
    for (int64_t i = block * block_size; i < std::min(visible, (block + 1) * block_size); ++i)
      for_each_tile(boxes[order[i]], first, end, per_row, [&](int64_t tile) { ++histogram[tile]; });
  }
  int64_t total = 0;
  for (int64_t tile = 0; tile < tiles; ++tile) {
    tile_start[tile] = total;
    for (int64_t block = 0; block < blocks; ++block) {
      const int64_t here = next[block * tiles + tile];
      next[block * tiles + tile] = total;
      total += here;
    }
  }
  tile_start[tiles] = total;
#pragma omp parallel for schedule(static, 1)
  for (int64_t block = 0; block < blocks; ++block) {
    int64_t *cursor = next.data() + block * tiles;
    for (int64_t i = block * block_size; i < std::min(visible, (block + 1) * block_size); ++i) {
      const int32_t index = order[i];
      int64_t slot = slot_start[index];
      for_each_tile(boxes[index], first, end, per_row, [&](int64_t tile) {
        const int64_t position = cursor[tile]++;
        instances[position] = index;
        slots[position] = slot++;
      });
    }
  }
}
