// Hybrid blending, forward: a block draws one chunk of pixels from the list of its tile, a thread each. Every pixel
// keeps its nearest fragments in its thread's own memory. The order of the list only decides ties; it is read to the
// end.
#include "blend.cuh"

namespace padgs {
namespace {

template <bool kPlanar, int kRoom>
__global__ void __launch_bounds__(kBatch) hybrid_kernel(BlendInputs args) {
  typedef typename PixelOf<kPlanar>::Type Pixel;
  __shared__ Batch batch;
  const PixelPlace place = pixel_place(args.table, blockIdx.x, int(threadIdx.x));
  const int begin = args.tile_start[place.chunk.tile], end = args.tile_start[place.chunk.tile + 1];
  const int y = place.y - place.chunk.y0;
  const Pixel pixel(args.rays, args.wrap, args.table.width, place.inside ? place.x : 0, place.inside ? place.y : 0);
  const bool largest = args.projection == kRay;
  Core<kRoom> core(args.core_size);
  Tail tail{0, 1, 0, 0, 0, 0};
  int evaluated = 0, contributing = 0, in_tail = 0;

  for (int first = begin; first < end; first += kBatch) {
    __syncthreads();  // nobody reads the last batch any more
    const int total = fill(batch, args, place.chunk, begin, first, end);
    for (int k = 0; k < total && place.inside; ++k) {
      const Reach reach = batch.reaches[k];
      if (y < reach.row || y >= reach.row_end) continue;
      const Footprint &f = batch.footprints[k];
      const typename Pixel::Pair pair = pixel.at(f);
      ++evaluated;
      if (!pair.reached) continue;
      Fragment rest{0.0f, smaller(exp2f(pair.log2_alpha), kAlphaMax), reach.gaussian};
      if (rest.alpha >= kCoreAlphaMin) rest = core.insert({pair.distance(f, largest), rest.alpha, reach.gaussian});
      if (rest.alpha == 0) continue;
      tail.add(rest.alpha, rest.gaussian == reach.gaussian ? f : args.footprints[rest.gaussian]);
      ++in_tail;
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
  launch(kernel, blocks_of(args.table), kBatch, queue, args);
}

}  // namespace

void hybrid_forward(const Queue &queue, const BlendInputs &args) {
  planar(args.projection) ? draw<true>(queue, args) : draw<false>(queue, args);
}

}  // namespace padgs
