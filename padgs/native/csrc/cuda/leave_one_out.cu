// Leave-one-out scores (leave_one_out.h): the backward pass of blend_backward.cu without
// derivatives. As there, warps sum over their pixels, their sums are added in order, and a slot is written once.
#include "../mathematics/leave_one_out.h"

#include "blend.cuh"

namespace padgs {
namespace {

constexpr int kRemovalBatch = 128;
constexpr int kSums = kRemoval - 1;  // the last is the largest contribution, and no sum
static_assert(kWarp * kRemoval <= kTilePixels, "a thread for each number of 32 instances");

template <class Pixel>
__global__ void __launch_bounds__(kTilePixels, kBlocks) removal_kernel(RemovalInputs args) {
  __shared__ Batch<kRemovalBatch> batch;
  __shared__ float partial[kWarps][kWarp][kRemoval];
  const BlendInputs &forward = args.forward;
  const int thread = int(threadIdx.x), warp = thread / kWarp, lane = lane_index(), own = dealt_index(kSums, lane);
  const PixelPlace place = pixel_place(forward.table, int(blockIdx.x), thread);
  const int begin = forward.tile_start[blockIdx.x], length = forward.tile_start[blockIdx.x + 1] - begin;
  const Pixel pixel = pixel_at<Pixel>(forward, place);
  RemovalPixel<float> state{1, {0, 0, 0}, {0, 0, 0}, 0};
  int end = 0;  // instances from here on draw nothing
  if (place.inside) {
    const float *image = forward.image + 3 * place.index, *target = args.target + 3 * place.index;
    const float *background = forward.background, left = forward.transmittance[place.index];
    state = {left,
             {left * background[0], left * background[1], left * background[2]},
             {image[0] - target[0], image[1] - target[1], image[2] - target[2]},
             args.weight[place.index]};
    end = forward.last[place.index];
  }
  const int furthest_of_warp = warp_max(end);

  for (int first = (length - 1) / batch.kSize * batch.kSize; first >= 0; first -= batch.kSize) {
    const int count = least(length - first, batch.kSize);
    fill(batch, forward, begin + first, count);
    __syncthreads();
    for (int group = (count - 1) / kWarp * kWarp; group >= 0; group -= kWarp) {
      for (float &number : partial[warp][lane]) number = 0;
      __syncwarp();
      for (unsigned left = reaching(batch, group, least(count, furthest_of_warp - first), place); left;) {
        const int bit = kWarp - 1 - __clz(int(left)), k = group + bit;
        left ^= 1u << bit;
        const Footprint &f = batch.footprints[k];
        const typename Pixel::Pair pair = pixel.at(f);
        const bool reached = first + k < end && pair.reached;
        if (!__any_sync(kAllLanes, reached)) continue;
        float sums[kSums] = {}, peak = 0;
        if (reached) {
          const float alpha = smaller(quick_exp2(pair.log2_alpha), kAlphaMax);
          const Removal<float> removal = remove_one(state, alpha, Vec3<float>{f.red, f.green, f.blue});
          sums[0] = removal.error, sums[1] = removal.change, sums[2] = state.weight * removal.contribution;
          peak = removal.contribution;
        }
        const float sum = dealt_sum(sums), largest = warp_max(peak);
        if (own >= 0) partial[warp][bit][own] = sum;
        if (lane == 0) partial[warp][bit][kSums] = largest;
      }
      __syncthreads();
      const int bit = thread / kRemoval, k = thread % kRemoval;
      if (bit < least(count - group, kWarp)) {
        float total = 0;
        for (int w = 0; w < kWarps; ++w)
          total = k < kSums ? total + partial[w][bit][k] : larger(total, partial[w][bit][k]);
        args.removals[int64_t(forward.slots[begin + first + group + bit]) * kRemoval + k] = total;
      }
      __syncthreads();  // before the numbers and the batch are overwritten
    }
  }
}

}  // namespace
}  // namespace padgs

using namespace padgs;

PADGS_API int padgs_cuda_leave_one_out(const Queue *queue, const RemovalInputs *args) {
  return on_device(*queue, [&] {
    const bool flat = planar(args->forward.projection);
    launch(flat ? removal_kernel<PlanarPixel> : removal_kernel<ProjectivePixel>, tiles_drawn(args->forward.table),
           kTilePixels, *queue, *args);
    return 0;
  });
}
