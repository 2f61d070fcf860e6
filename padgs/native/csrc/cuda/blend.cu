// Sorted blending, forward: a block draws one chunk of pixels, front to back, from the list of its tile. Paper Eq. 4-5.
#include "blend.cuh"

namespace padgs {
namespace {

template <bool kPlanar>
__global__ void __launch_bounds__(kBatch) blend_kernel(BlendInputs args) {
  typedef typename PixelOf<kPlanar>::Type Pixel;
  __shared__ Batch batch;
  const PixelPlace place = pixel_place(args.table, blockIdx.x, int(threadIdx.x));
  const int begin = args.tile_start[place.chunk.tile], end = args.tile_start[place.chunk.tile + 1];
  const int y = place.y - place.chunk.y0;
  const Pixel pixel(args.rays, args.wrap, args.table.width, place.inside ? place.x : 0, place.inside ? place.y : 0);
  bool running = place.inside;
  float transmittance = 1, red = 0, green = 0, blue = 0, depth = 0;
  float coverage = 0;  // sum of weights; 1 - transmittance would leave few digits of a faint pixel
  int last = 0, evaluated = 0, contributing = 0;

  for (int first = begin; first < end; first += kBatch) {
    if (!__syncthreads_or(running)) break;  // and nobody reads the last batch any more
    const int total = fill(batch, args, place.chunk, begin, first, end);
    for (int k = 0; k < total && running; ++k) {
      if (y < batch.reaches[k].row || y >= batch.reaches[k].row_end) continue;
      const Footprint &f = batch.footprints[k];
      const typename Pixel::Pair pair = pixel.at(f);
      ++evaluated;
      if (!pair.reached) continue;
      const float alpha = smaller(exp2f(pair.log2_alpha), kAlphaMax);
      const float next = transmittance - transmittance * alpha;
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
      last = batch.position[k];
      ++contributing;
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
      launch(planar(args->projection) ? blend_kernel<true> : blend_kernel<false>, blocks_of(args->table), kBatch, *queue,
             *args);
    return 0;
  });
}
