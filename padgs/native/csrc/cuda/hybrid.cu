// Hybrid blending, forward: a block draws one tile, a thread for each pixel, which keeps its nearest fragments in its own
// memory. The order of the list only decides ties; it is read to the end.
#include "blend.cuh"

namespace padgs {
namespace {

template <bool kPlanar, int kRoom>
__global__ void __launch_bounds__(kTilePixels, kBlocks) hybrid_kernel(BlendInputs args) {
  typedef typename PixelOf<kPlanar>::Type Pixel;
  __shared__ Batch<kTilePixels> batch;
  const PixelPlace place = pixel_place(args.table, int(blockIdx.x), int(threadIdx.x));
  const int begin = args.tile_start[blockIdx.x], length = args.tile_start[blockIdx.x + 1] - begin;
  const Pixel pixel = pixel_at<Pixel>(args, place);
  const bool largest = args.projection == kRay;
  Core<kRoom> core(args.core_size);
  Tail tail{0, 1, 0, 0, 0, 0};
  int evaluated = 0, contributing = 0, in_tail = 0;

  for (int first = 0; first < length; first += batch.kSize) {
    __syncthreads();  // before the batch is overwritten
    const int count = least(length - first, batch.kSize);
    fill(batch, args, begin + first, count);
    __syncthreads();
    for (int group = 0; group < count; group += kWarp) {
      for (unsigned left = reaching(batch, group, count, place); left; left &= left - 1) {
        const int k = group + __ffs(left) - 1;
        if (!place.inside) continue;
        const Footprint &f = batch.footprints[k];
        const int32_t gaussian = batch.reaches[k].gaussian;
        const typename Pixel::Pair pair = pixel.at(f);
        ++evaluated;
        if (!pair.reached) continue;
        Fragment rest{0.0f, smaller(quick_exp2(pair.log2_alpha), kAlphaMax), gaussian};
        if (rest.alpha >= kCoreAlphaMin) rest = core.insert({pair.distance(f, largest), rest.alpha, gaussian});
        if (rest.alpha == 0) continue;
        tail.add(rest.alpha, rest.gaussian == gaussian ? f : args.footprints[rest.gaussian]);
        ++in_tail;
      }
    }
  }

  if (place.inside) {
    int32_t *kept = args.core ? args.core + place.index * args.core_size : nullptr;
    float left = 1, red = 0, green = 0, blue = 0, depth = 0, coverage = 0;
    int k = 0;
    for (; k < core.filled && left > 0; ++k) {
      const Fragment fragment = core.places[k];
      const Footprint &f = args.footprints[fragment.gaussian];
      const float weight = fragment.alpha * left;
      red += weight * f.red;
      green += weight * f.green;
      blue += weight * f.blue;
      depth += weight * f.depth;
      coverage += weight;
      left = left_behind(left, weight);
      if (kept) kept[k] = fragment.gaussian;
    }
    if (kept && k < core.size) kept[k] = -1;
    if (args.tails) args.tails[place.index] = tail;
    contributing = k + (left > 0 ? in_tail : 0);
    const float share = left * tail.opacity_per_alpha(), transmittance = left * tail.left;
    coverage += share * tail.alpha;
    float *image = args.image + 3 * place.index;
    image[0] = red + share * tail.red + transmittance * args.background[0];
    image[1] = green + share * tail.green + transmittance * args.background[1];
    image[2] = blue + share * tail.blue + transmittance * args.background[2];
    args.transmittance[place.index] = transmittance;
    args.depth[place.index] = coverage > 0 ? (depth + share * tail.depth) / coverage : 0.0f;
  }
  write_pair_counts(args, evaluated, contributing);
}

// Every thread of a GPU that may run has room for its core reserved: as little as will do.
template <bool kPlanar>
void draw(const Queue &queue, const BlendInputs &args) {
  const auto kernel = args.core_size <= 16   ? hybrid_kernel<kPlanar, 16>
                      : args.core_size <= 64 ? hybrid_kernel<kPlanar, 64>
                                             : hybrid_kernel<kPlanar, kMaxCoreSize>;
  launch(kernel, tiles_drawn(args.table), kTilePixels, queue, args);
}

}  // namespace

void hybrid_forward(const Queue &queue, const BlendInputs &args) {
  planar(args.projection) ? draw<true>(queue, args) : draw<false>(queue, args);
}

}  // namespace padgs
