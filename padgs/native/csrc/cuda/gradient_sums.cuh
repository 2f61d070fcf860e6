// Blending, backward: a block goes through the list of its tile from behind, a thread for each pixel, and leaves the
// gradient sums (sums over pixels from which gradients are computed) of every instance in its slot.
//
// A warp visits the instances that reach its 8x4 pixels, sums their gradients over its lanes, and leaves them in shared
// memory; the sums of the eight warps are then added in order. Nothing is kept from the forward pass but what each pixel
// ended with, no float is added atomically, and a slot is written once: the results do not depend on scheduling.
#pragma once

#include "blend.cuh"

namespace padgs {

constexpr int kColorSum = 10;  // colour and depth; before it the shape's
constexpr int kGradientBatch = 128;

// Common state of the fragments of a pixel in the backward pass.
struct Upstream {
  float red, green, blue, depth;  // dL/d of the values that weights multiply

  __device__ float along(float r, float g, float b, float z) const { return red * r + green * g + blue * b + depth * z; }
  __device__ float along(const Footprint &f) const { return along(f.red, f.green, f.blue, f.depth); }
};
// dL by the colour and by the transmittance of a pixel.
__device__ inline float load_upstream(const BlendGradientInputs &args, int64_t p, Upstream &upstream) {
  const float *grad = args.grad_image + 3 * p, *background = args.forward.background;
  upstream = {grad[0], grad[1], grad[2], 0.0f};
  const float grad_t = args.grad_transmittance ? args.grad_transmittance[p] : 0.0f;
  return grad_t + (grad[0] * background[0] + grad[1] * background[1] + grad[2] * background[2]);
}

__device__ inline void write_ray_gradient(const BlendGradientInputs &args, const PixelPlace &place,
                                          Vec3<float> gradient) {
  const int64_t stride = int64_t(chunks(args.forward.table.width)) * kTile;
  float *out = args.grad_rays + 3 * stride * place.y + place.x;
  out[0] = gradient.x, out[stride] = gradient.y, out[2 * stride] = gradient.z;
}

// A State is one pixel of a way of blending:
//   State(args, place, length)                  before any of the `length` instances of the list is visited
//   end                                         instances from here on draw nothing
//   up                                          what the weights are multiplied with
//   step_back(f, gaussian, log2_alpha, weight)  visits one; returns M = dL/d(ln alpha), and its weight
template <class Pixel, class State, bool kWithRays>
__global__ void __launch_bounds__(kTilePixels, kBlocks) gradient_sums_kernel(BlendGradientInputs args) {
  constexpr bool kPlanar = Pixel::Pair::kGradientSums < kColorSum;
  constexpr int kShape = Pixel::Pair::kGradientSums, kSums = kShape + 4 + !kPlanar;  // colour, depth; absgrad
  __shared__ Batch<kGradientBatch> batch;
  __shared__ float partial[kWarps][kWarp][kSums];
  __shared__ bool summed_by[kWarp][kWarps];  // which instances of the group each warp has sums of
  __shared__ int furthest_of_block;
  const BlendInputs &forward = args.forward;
  const int thread = int(threadIdx.x), warp = thread / kWarp, lane = lane_index(), own = dealt_index(kSums, lane);
  const int number = thread % kGradientSums;  // of the sum that the thread adds up; some are unused
  const int shared_sum = number < kShape ? number : number < kColorSum ? kSums : number - kColorSum + kShape;
  const PixelPlace place = pixel_place(forward.table, int(blockIdx.x), thread);
  const int begin = forward.tile_start[blockIdx.x], length = forward.tile_start[blockIdx.x + 1] - begin;
  const Pixel pixel = pixel_at<Pixel>(forward, place);
  State state(args, place, length);
  Vec3<float> grad_ray{0, 0, 0};

  if (thread == 0) furthest_of_block = 0;
  __syncthreads();
  const int furthest_of_warp = warp_max(state.end);
  if (lane == 0) atomicMax(&furthest_of_block, furthest_of_warp);
  __syncthreads();
  const int furthest = furthest_of_block;
  for (int64_t i = int64_t(furthest) * kGradientSums + thread; i < int64_t(length) * kGradientSums; i += kTilePixels)
    args.gradient_sums[forward.slots[begin + i / kGradientSums]].of[i % kGradientSums] = 0;

  for (int first = (furthest - 1) / batch.kSize * batch.kSize; first >= 0 && furthest > 0; first -= batch.kSize) {
    const int count = least(furthest - first, batch.kSize);
    fill(batch, forward, begin + first, count);
    __syncthreads();
    for (int group = (count - 1) / kWarp * kWarp; group >= 0; group -= kWarp) {
      unsigned summed = 0;
      for (unsigned left = reaching(batch, group, least(count, furthest_of_warp - first), place); left;) {
        const int bit = kWarp - 1 - __clz(int(left)), k = group + bit;
        left ^= 1u << bit;
        const Footprint &f = batch.footprints[k];
        const typename Pixel::Pair pair = pixel.at(f);
        const bool reached = first + k < state.end && pair.reached;
        if (!__any_sync(kAllLanes, reached)) continue;
        float sums[kSums] = {};
        if (reached) {
          float weight;
          const float m = state.step_back(f, batch.reaches[k].gaussian, pair.log2_alpha, weight);
          pair.gradient_sums(m, sums);
          sums[kShape] = weight * state.up.red;
          sums[kShape + 1] = weight * state.up.green;
          sums[kShape + 2] = weight * state.up.blue;
          sums[kShape + 3] = weight * state.up.depth;
          if constexpr (!kPlanar) sums[kSums - 1] = args.absgrad ? pair.absgrad(f, m) : 0.0f;
          if constexpr (kWithRays) grad_ray = grad_ray + pixel.ray_gradient(f, pair, m);
        }
        const float sum = dealt_sum(sums);
        if (own >= 0) partial[warp][bit][own] = sum;
        summed |= 1u << bit;
      }
      summed_by[lane][warp] = summed >> lane & 1;
      __syncthreads();
      for (int bit = thread / kGradientSums; bit < least(count - group, kWarp); bit += kTilePixels / kGradientSums) {
        float total = 0;
        if (shared_sum < kSums)
          for (int w = 0; w < kWarps; ++w)
            if (summed_by[bit][w]) total += partial[w][bit][shared_sum];
        args.gradient_sums[forward.slots[begin + first + group + bit]].of[number] = total;
      }
      __syncthreads();  // before the sums and the batch are overwritten
    }
  }
  if constexpr (kWithRays)
    if (place.inside) write_ray_gradient(args, place, grad_ray);
}

template <class PlanarState, class ProjectiveState>
void launch_gradient_sums(const Queue &queue, const BlendGradientInputs &args) {
  const bool flat = planar(args.forward.projection);
  const auto kernel = flat             ? gradient_sums_kernel<PlanarPixel, PlanarState, false>
                      : args.grad_rays ? gradient_sums_kernel<ProjectivePixel, ProjectiveState, true>
                                       : gradient_sums_kernel<ProjectivePixel, ProjectiveState, false>;
  launch(kernel, tiles_drawn(args.forward.table), kTilePixels, queue, args);
}

}  // namespace padgs
