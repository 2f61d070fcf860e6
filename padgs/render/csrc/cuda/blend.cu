// Blending, forward: a block draws one chunk of pixels, front to back, from the list of its tile. Paper Eq. 4-5.
#include "blend.cuh"

namespace padgs {
namespace {

constexpr int kWarps = kBatch / kWarp;

// How many threads of lower rank have `chosen`, and how many all have.
__device__ int rank_in_block(bool chosen, int *counts, int &total) {
  const unsigned votes = __ballot_sync(kAllLanes, chosen);
  const int warp = int(threadIdx.x) / kWarp;
  if (lane_index() == 0) counts[warp] = __popc(votes);
  __syncthreads();
  int rank = __popc(votes & ((1u << lane_index()) - 1));
  total = 0;
  for (int w = 0; w < kWarps; ++w) {
    rank += w < warp ? counts[w] : 0;
    total += counts[w];
  }
  return rank;
}

template <bool kPlanar>
__global__ void __launch_bounds__(kBatch) blend_kernel(BlendInputs args) {
  typedef typename PixelOf<kPlanar>::Type Pixel;
  __shared__ Batch batch;
  __shared__ int counts[kWarps];
  const int thread = int(threadIdx.x);
  const PixelPlace place = pixel_place(args.table, blockIdx.x, thread);
  const int begin = args.tile_start[place.chunk.tile], end = args.tile_start[place.chunk.tile + 1];
  const int y = place.y - place.chunk.y0, chunk = place.chunk.chunk;
  const Pixel pixel(args.rays, args.wrap, args.table.width, place.inside ? place.x : 0, place.inside ? place.y : 0);
  bool running = place.inside;
  float transmittance = 1, red = 0, green = 0, blue = 0, depth = 0;
  float coverage = 0;  // sum of weights: 1 - transmittance without the difference, which leaves few digits of a faint pixel
  int last = 0, evaluated = 0, contributing = 0;

  for (int first = begin; first < end; first += kBatch) {
    if (!__syncthreads_or(running)) break;  // and nobody reads the last batch any more
    const int at = first + thread;
    Reach reach{};
    bool chosen = at < end;
    if (chosen) {
      reach = args.reaches[args.slots[at]];
      chosen = reach.chunk <= chunk && chunk < reach.chunk_end;
    }
    int total;
    const int rank = rank_in_block(chosen, counts, total);
    if (chosen) {
      batch.footprints[rank] = args.footprints[reach.gaussian];
      batch.position[rank] = at - begin + 1;
      batch.row[rank] = reach.row;
      batch.row_end[rank] = reach.row_end;
    }
    __syncthreads();
    for (int k = 0; k < total && running; ++k) {
      if (y < batch.row[k] || y >= batch.row_end[k]) continue;
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
  if (!args.pair_counts) return;
  __shared__ int pairs[2];
  if (thread < 2) pairs[thread] = 0;
  __syncthreads();
  evaluated = warp_sum(evaluated), contributing = warp_sum(contributing);
  if (lane_index() == 0) atomicAdd(pairs, evaluated), atomicAdd(pairs + 1, contributing);
  __syncthreads();
  if (thread < 2) args.pair_counts[2 * int64_t(blockIdx.x) + thread] = pairs[thread];
}

}  // namespace
}  // namespace padgs

using namespace padgs;

PADGS_API int padgs_cuda_blend(const Queue *queue, const BlendInputs *args) {
  if (const int error = begin(*queue)) return error;
  launch(planar(args->projection) ? blend_kernel<true> : blend_kernel<false>, blocks_of(args->table), kBatch, *queue, *args);
  return finish();
}
