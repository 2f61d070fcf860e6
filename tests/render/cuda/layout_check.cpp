// csrc/cuda/layout.h and device.cuh for tests: what they say of every bucket, chunk and block, and of devices.
#include "device.cuh"
#include "layout.h"

using namespace padgs;

// The tile of each bucket [buckets]; -1 for the gaps in their numbering.
extern "C" void check_buckets(const int32_t *tile_start, int32_t tiles, int64_t buckets, int32_t *tile) {
  for (int64_t b = 0; b < buckets; ++b) {
    const int t = tile_of_bucket(tile_start, tiles, b);
    const int64_t from = (b - first_bucket(tile_start[t], t)) * kBucket;
    tile[b] = from < tile_start[t + 1] - tile_start[t] ? t : -1;
  }
}

// Row and places of states of one bucket [1 + 2^level].
extern "C" int32_t check_states(const TileTable *table, const int32_t *tile_start, int32_t tile, int64_t bucket,
                                int64_t *places) {
  const int row = row_of_tile(*table, tile);
  for (int chunk = 0; chunk < 1 << table->level[row]; ++chunk)
    places[chunk] = state_index(*table, tile_start, row, bucket, chunk);
  return row;
}

// Where each block draws [blocks, 6].
extern "C" int64_t check_blocks(const TileTable *table, ChunkPlace *places) {
  const int64_t blocks = chunks_drawn(*table);
  for (int64_t b = 0; places && b < blocks; ++b) places[b] = chunk_place(*table, b);
  return blocks;
}

// Work on one device whose launches and own return leave errors. Returns the error; the device within and those
// afterwards [3]: current device, and the error that the next call would find.
extern "C" int check_on_device(int32_t device, int32_t current, int32_t of_work, int32_t of_launch, int32_t *found) {
  current_device = current;
  const int error = on_device({device, nullptr}, [&] {
    found[0] = current_device;
    last_error = of_launch;
    return int(of_work);
  });
  found[1] = current_device, found[2] = last_error;
  return error;
}

extern "C" int64_t check_lower_bound(const uint32_t *keys, int64_t count, uint32_t key) {
  return lower_bound(keys, count, key);
}
