// Sorted blending, forward: a block draws one tile, front to back. Paper Eq. 4-5.
#include "blend.cuh"

namespace padgs {
namespace {

template <bool kPlanar>
__global__ void __launch_bounds__(kTilePixels, kBlocks) blend_kernel(BlendInputs args) {
  typedef typename PixelOf<kPlanar>::Type Pixel;
  __shared__ Batch<kTilePixels> batch;
  const PixelPlace place = pixel_place(args.table, int(blockIdx.x), int(threadIdx.x));
  const int begin = args.tile_start[blockIdx.x], length = args.tile_start[blockIdx.x + 1] - begin;
  const Pixel pixel = pixel_at<Pixel>(args, place);
  bool running = place.inside;
  float transmittance = 1, red = 0, green = 0, blue = 0, depth = 0;
  float coverage = 0;  // sum of weights; 1 - transmittance would leave few digits of a faint pixel
  int last = 0, evaluated = 0, contributing = 0;

  for (int first = 0; first < length; first += batch.kSize) {
    if (!__syncthreads_or(running)) break;  // and before the batch is overwritten
    const int count = least(length - first, batch.kSize);
    fill(batch, args, begin + first, count);
    __syncthreads();
    for (int group = 0; group < count && __any_sync(kAllLanes, running); group += kWarp) {
      for (unsigned left = reaching(batch, group, count, place); left; left &= left - 1) {
        const int k = group + __ffs(left) - 1;
        if (!running) continue;
        const Footprint &f = batch.footprints[k];
        const typename Pixel::Pair pair = pixel.at(f);
        ++evaluated;
        if (!pair.reached) continue;
        const float alpha = smaller(quick_exp2(pair.log2_alpha), kAlphaMax);
        const float next = fmaf(-transmittance, alpha, transmittance);
        if (next < kTransmittanceMin) {
          running = false;
          continue;
        }
        const float weight = alpha * transmittance;
        red += weight * f.red;
        green += weight * f.green;
        blue += weight * f.blue;
        depth += weight * f.depth;
        coverage += weight;
        transmittance = next;
        last = first + k + 1;
        ++contributing;
      }
    }
  }

  if (place.inside) {
    float *image = args.image + 3 * place.index;
    image[0] = red + transmittance * args.background[0];
    image[1] = green + transmittance * args.background[1];
    image[2] = blue + transmittance * args.background[2];
    args.transmittance[place.index] = transmittance;
    args.depth[place.index] = coverage > 0 ? depth / coverage : 0.0f;
    args.last[place.index] = last;
  }
  write_pair_counts(args, evaluated, contributing);
}

}  // namespace
}  // namespace padgs

using namespace padgs;

PADGS_API int padgs_cuda_blend(const Queue *queue, const BlendInputs *args) {
  return on_device(*queue, [&] {
    if (args->core_size)
      hybrid_forward(*queue, *args);
    else
      launch(planar(args->projection) ? blend_kernel<true> : blend_kernel<false>, tiles_drawn(args->table), kTilePixels,
             *queue, *args);
    return 0;
  });
}
