// csrc/cuda/layout.h and device.cuh for tests: what they say of every pixel, sum and device.
#include "device.cuh"
#include "layout.h"

using namespace padgs;

// Where each thread of each block draws [blocks, 256], and which of the instances of its block reach its warp's part of
// the tile, a bit each [blocks, 256].
extern "C" void check_pixels(const TileTable *table, const Reach *reaches, int32_t count, PixelPlace *places,
                             int32_t *reached) {
  for (int64_t i = 0; i < tiles_drawn(*table) * kTilePixels; ++i) {
    places[i] = pixel_place(*table, int(i / kTilePixels), int(i % kTilePixels));
    for (int k = 0; k < count; ++k) reached[i] |= int(reaches_part(reaches[k], places[i])) << k;
  }
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

// Which of `count` sums each lane of a warp has [32].
extern "C" void check_dealt_index(int32_t count, int32_t *index) {
  for (int lane = 0; lane < kWarp; ++lane) index[lane] = dealt_index(count, lane);
}

extern "C" int64_t check_lower_bound(const uint32_t *keys, int64_t count, uint32_t key) {
  return lower_bound(keys, count, key);
}
