// Order and tiles: one depth sort of the Gaussians, then a stable counting sort of their tile instances, so that every
// tile's list is front to back without sorting any tile. The result does not depend on the number of threads.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "runs.h"

namespace padgs {
namespace {

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

// Calls visit(tile, instance part) for each drawn tile of the box, in a fixed order.
template <typename Visit>
void for_each_tile(const PixelBox &box, const TileGrid &grid, Visit visit) {
  if (box.row == box.row_end) return;
  const int end = std::min((box.row_end - 1) / kTile + 1, grid.end_row);
  for (int row = std::max(box.row / kTile, grid.first_row); row < end; ++row) {
    const int level = grid.level[row], y0 = row * kTile;
    const int64_t base = grid.row_start[row - grid.first_row];
    Instance part{};
    part.row = uint8_t(std::max(box.row - y0, 0));
    part.row_end = uint8_t(std::min(box.row_end - y0, kTile));
    Run runs[2];
    const int count = runs_in_row(box, level, runs);
    for (int r = 0; r < count; ++r)
      for (int tile = runs[r].tile; tile < runs[r].tile_end; ++tile) {
        const int first = tile << level;
        part.chunk = uint8_t(std::max(runs[r].chunk - first, 0));
        part.chunk_end = uint8_t(std::min(runs[r].chunk_end - first, 1 << level));
        visit(base + tile, part);
      }
  }
}

}  // namespace
}  // namespace padgs

using namespace padgs;

// Widths of tiles by row, so that a tile covers about the same angle at every latitude: level = round(log2(1 / cos)).
PADGS_API void padgs_tile_levels(const Camera *camera, int32_t *level) {
  const int rows = int(chunks(camera->height));
  for (int row = 0; row < rows; ++row) {
    level[row] = 0;
    if (camera->model != kPanoramaModel || camera->square) continue;
    const double latitude = ((row + 0.5) * kTile / camera->height - 0.5) * 3.14159265358979323846;
    const int wanted = int(std::lround(std::log2(1 / std::max(std::cos(latitude), 1e-3))));
    while (level[row] < std::min(wanted, kMaxLevel) && (2 << level[row]) <= chunks(camera->width)) ++level[row];
  }
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
  for (int64_t i = 0; i < count; ++i) {
    const PixelBox &box = boxes[i];
    if (box.row == box.row_end) continue;
    for (int row = box.row / kTile; row <= (box.row_end - 1) / kTile; ++row) {
      Run runs[2];
      const int pieces = runs_in_row(box, level[row], runs);
      for (int r = 0; r < pieces; ++r) per_row[row] += runs[r].tile_end - runs[r].tile;
    }
  }
}

// Fills the lists of the grid's drawn tiles.
//   slot_start [N + 1]: where each Gaussian's moments begin; its instances are consecutive there
//   tile_start [tiles + 1], instances [I]
PADGS_API void padgs_bin(const PixelBox *boxes, int64_t count, const int32_t *order, int64_t visible,
                         const TileGrid *grid, int64_t *slot_start, int64_t *tile_start, Instance *instances) {
  const int64_t tiles = grid->row_start[grid->end_row - grid->first_row];
  std::fill_n(slot_start, count + 1, int64_t(0));
  // Each block of Gaussians, in depth order, has its own histogram: blocks can be filled at the same time.
  const int64_t block_size = std::max<int64_t>(4096, (visible + 63) / 64);
  const int64_t blocks = (visible + block_size - 1) / block_size;
  std::vector<int64_t> next(blocks * tiles, 0);
#pragma omp parallel for schedule(static, 1)
  for (int64_t block = 0; block < blocks; ++block) {
    int64_t *histogram = next.data() + block * tiles;
    for (int64_t i = block * block_size; i < std::min(visible, (block + 1) * block_size); ++i) {
      int64_t own = 0;
      for_each_tile(boxes[order[i]], *grid, [&](int64_t tile, const Instance &) { ++histogram[tile], ++own; });
      slot_start[order[i] + 1] = own;
    }
  }
  for (int64_t i = 0; i < count; ++i) slot_start[i + 1] += slot_start[i];
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
      uint32_t slot = uint32_t(slot_start[index]);
      for_each_tile(boxes[index], *grid, [&](int64_t tile, Instance part) {
        part.gaussian = index;
        part.slot = slot++;
        instances[cursor[tile]++] = part;
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
