// Tile lists: one stable sort of the instances by tile, of Gaussians that are in depth order already, so that every
// list is front to back.
#include "sort.cuh"

namespace padgs {
namespace {

constexpr int kThreads = 128;
constexpr int kWarps = kThreads / kWarp;

__global__ void __launch_bounds__(kThreads) count_kernel(BinArguments args) {
  const int64_t i = global_thread();
  if (i <= args.visible) args.tiles[i] = i < args.visible ? tiles_of(args.boxes[args.order[i]], args.table) : 0;
}

// A warp lists the instances of 32 Gaussians, as many to each lane whatever their sizes, and writes them side by
// side; those that there is no room for are left out.
__global__ void __launch_bounds__(kThreads) emit_kernel(BinArguments args) {
  __shared__ PixelBox boxes[kWarps][kWarp];
  __shared__ int32_t gaussians[kWarps][kWarp];
  __shared__ uint32_t starts[kWarps][kWarp];
  const int warp = int(threadIdx.x) / kWarp, lane = lane_index();
  const int64_t first = global_thread() - lane, i = first + lane;
  if (i < args.visible) {
    gaussians[warp][lane] = args.order[i];
    boxes[warp][lane] = args.boxes[args.order[i]];
  }
  starts[warp][lane] = args.slot_start[i < args.visible ? i : args.visible];
  __syncwarp();
  if (first >= args.visible) return;
  const int64_t listed = args.slot_start[first + kWarp < args.visible ? first + kWarp : args.visible];
  const uint32_t end = uint32_t(listed < args.sort.count ? listed : args.sort.count);
  for (uint32_t slot = starts[warp][0] + uint32_t(lane); slot < end; slot += kWarp) {
    int owner = 0;  // the last that starts at or before this slot; those after it that start there too are empty
    for (int step = kWarp / 2; step; step /= 2)
      if (starts[warp][owner + step] <= slot) owner += step;
    Reach reach;
    const int tile = nth_tile(boxes[warp][owner], args.table, slot - starts[warp][owner], reach);
    reach.gaussian = gaussians[warp][owner];
    args.reaches[slot] = reach;
    args.sort.keys[slot] = uint32_t(tile);
    args.sort.values[slot] = int32_t(slot);
  }
}

__global__ void __launch_bounds__(kThreads) tile_start_kernel(BinArguments args, int tiles) {
  const int64_t tile = global_thread();
  if (tile <= tiles)
    args.tile_start[tile] = int32_t(lower_bound(args.sort.sorted_keys, args.sort.count, uint32_t(tile)));
}

}  // namespace
}  // namespace padgs

using namespace padgs;

// The caller, which knows the rows of the table, passes the number of tiles.
PADGS_API int padgs_cuda_bin(const Queue *queue, const BinArguments *args, int32_t tiles) {
  return on_device(*queue, [&] {
    // Without an instance too: the backward pass asks each Gaussian where its instances begin and end.
    launch(count_kernel, blocks_for(args->visible + 1, kThreads), kThreads, *queue, *args);
    if (const int error = exclusive_sum(*queue, args->sort, args->tiles, args->slot_start, args->visible + 1))
      return error;
    if (args->sort.count) {
      launch(emit_kernel, blocks_for(args->visible, kThreads), kThreads, *queue, *args);
      if (const int error = sort_pairs(*queue, args->sort)) return error;
    }
    launch(tile_start_kernel, blocks_for(int64_t(tiles) + 1, kThreads), kThreads, *queue, *args, tiles);
    return 0;
  });
}
