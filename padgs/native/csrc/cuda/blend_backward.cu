// Sorted blending, backward, in two passes over the same lists, both back to front.
//
// The first has a thread for each pixel. It leaves, behind every bucket of 32 instances, how much light still passes
// and what lies behind. The second has a thread for each instance: a warp takes a bucket and the pixels of a chunk
// pass through it, entering at the last lane and handed on from lane to lane, so that every instance sums its own
// moments in registers. No sum crosses threads, no float is added atomically: the results do not depend on
// scheduling.
#include "blend.cuh"

namespace padgs {
namespace {

constexpr int kGaussiansPerBlock = 16;

// dL/d of one pixel, as the definition of its outputs gives it; blend.cpp of the CPU does so by patches.
__device__ PixelState load_pixel(const BlendGradientInputs &args, int64_t p, Upstream &upstream) {
  const float t = args.forward.transmittance[p];
  float grad_t = load_upstream(args, p, upstream);
  if (args.grad_depth && t < 1) {  // depth = sum(w r) / (1 - T)
    upstream.depth = args.grad_depth[p] / (1.0f - t);
    grad_t += upstream.depth * args.forward.depth[p];
  }
  return {t, t * grad_t};
}

// One pair on the way back: moves the pixel's state in front of it. Returns M = dL/d(ln alpha).
__device__ float step_back(const Footprint &f, float log2_alpha, const Upstream &up, PixelState &state, float &weight) {
  const float full = exp2f(log2_alpha), alpha = smaller(full, kAlphaMax);
  const float inverse = quick_inverse(1.0f - alpha);
  state.transmittance *= inverse;
  weight = alpha * state.transmittance;
  const float signal = weight * (up.red * f.red + up.green * f.green + up.blue * f.blue + up.depth * f.depth);
  // alpha dL/dalpha = T alpha (c . G) - (what is behind) alpha / (1 - alpha), and 0 where alpha is limited.
  const float m = full < kAlphaMax ? signal - state.behind * (inverse * alpha) : 0.0f;
  state.behind += signal;
  return m;
}

template <bool kPlanar, bool kWithRays>
__global__ void __launch_bounds__(kBatch) states_kernel(BlendGradientInputs args) {
  typedef typename PixelOf<kPlanar>::Type Pixel;
  __shared__ Batch batch;
  __shared__ int furthest_of_block;
  const BlendInputs &forward = args.forward;
  const int thread = int(threadIdx.x);
  const PixelPlace place = pixel_place(forward.table, blockIdx.x, thread);
  const int begin = forward.tile_start[place.chunk.tile], y = place.y - place.chunk.y0, chunk = place.chunk.chunk;
  const Pixel pixel(forward.rays, forward.wrap, forward.table.width, place.inside ? place.x : 0,
                    place.inside ? place.y : 0);
  Upstream upstream{};
  PixelState state{1.0f, 0.0f};
  int last = 0;
  if (place.inside) {
    state = load_pixel(args, place.index, upstream);
    args.upstream[place.index] = upstream;
    last = forward.last[place.index];
  }
  if (thread == 0) furthest_of_block = 0;
  __syncthreads();
  const int furthest_of_warp = warp_max(last);
  if (lane_index() == 0) atomicMax(&furthest_of_block, furthest_of_warp);
  __syncthreads();
  const int furthest = furthest_of_block;
  if (thread == 0) args.furthest[blockIdx.x] = furthest;

  const int64_t bucket = first_bucket(begin, place.chunk.tile);
  Vec3<float> grad_ray{0, 0, 0};
  for (int first = (furthest - 1) / kBatch * kBatch; first >= 0 && furthest > 0; first -= kBatch) {
    __syncthreads();
    const int at = first + thread;
    batch.reaches[thread] = Reach{};
    if (at < furthest) {
      const Reach reach = forward.reaches[forward.slots[begin + at]];
      if (reach.chunk <= chunk && chunk < reach.chunk_end) {
        batch.footprints[thread] = forward.footprints[reach.gaussian];
        batch.reaches[thread] = reach;
      }
    }
    __syncthreads();
    for (int k = least(furthest - first, kBatch) - 1; k >= 0; --k) {
      if (k % kBucket == kBucket - 1 || first + k == furthest - 1)
        args.states[kChunkPixels * state_index(forward.table, forward.tile_start, place.chunk.row,
                                               bucket + (first + k) / kBucket, chunk) + thread] = state;
      if (first + k >= last || y < batch.reaches[k].row || y >= batch.reaches[k].row_end) continue;
      const Footprint &f = batch.footprints[k];
      const typename Pixel::Pair pair = pixel.at(f);
      if (!pair.reached) continue;
      float weight;
      const float m = step_back(f, pair.log2_alpha, upstream, state, weight);
      if constexpr (kWithRays) grad_ray = grad_ray + pixel.ray_gradient(f, pair, m);
    }
  }
  if constexpr (kWithRays)
    if (place.inside) write_ray_gradient(args, place, grad_ray);
}

template <bool kPlanar>
__global__ void __launch_bounds__(kBucketThreads) buckets_kernel(BlendGradientInputs args, int tiles) {
  typedef typename PixelOf<kPlanar>::Type Pixel;
  const BlendInputs &forward = args.forward;
  const TileTable &table = forward.table;
  BucketLane own;
  if (!take_bucket(forward, args.instances, tiles, own)) return;
  const Reach &reach = own.reach;
  const Footprint &f = own.footprint;
  const int lane = lane_index(), row = own.row, level = own.level, column = own.column, y0 = row * kTile;
  Moments moments{};
  float *sums = moments.of;

  for (int chunk = 0; chunk < 1 << level && column + chunk < chunks(table.width); ++chunk) {
    const int furthest = args.furthest[int64_t(row - table.first_row) * chunks(table.width) + column + chunk];
    if (own.from >= furthest) continue;
    const bool active = own.mine && reach.chunk <= chunk && chunk < reach.chunk_end && own.at < furthest;
    int top, bottom;
    rows_of_warp(active, reach, top, bottom);
    const int pixels = (bottom - top) * kTile;  // negative where no lane is active
    const int64_t states = kChunkPixels * state_index(table, forward.tile_start, row, own.bucket, chunk) + top * kTile;
    const int x0 = (column + chunk) * kTile;
    PixelState state{1.0f, 0.0f};
    for (int step = 0; step < pixels + kBucket - 1; ++step) {
      const PixelState handed{__shfl_down_sync(kAllLanes, state.transmittance, 1),
                              __shfl_down_sync(kAllLanes, state.behind, 1)};
      const int k = step - (kBucket - 1 - lane);
      if (k < 0 || k >= pixels) continue;
      state = lane == kBucket - 1 ? args.states[states + k] : handed;
      const int x = x0 + k % kTile, row_in_tile = top + k / kTile, y = y0 + row_in_tile;
      if (!active || row_in_tile < reach.row || row_in_tile >= reach.row_end || x >= table.width) continue;
      const int64_t p = int64_t(y) * table.width + x;
      if (own.at >= forward.last[p]) continue;
      const Pixel pixel(forward.rays, forward.wrap, table.width, x, y);
      const typename Pixel::Pair pair = pixel.at(f);
      if (!pair.reached) continue;
      const Upstream upstream = args.upstream[p];
      float weight;
      const float m = step_back(f, pair.log2_alpha, upstream, state, weight);
      pair.add(m, sums);
      if (args.absolute) sums[kAbsoluteMoment] += pair.pull(f, m);
      sums[10] += weight * upstream.red;
      sums[11] += weight * upstream.green;
      sums[12] += weight * upstream.blue;
      sums[13] += weight * upstream.depth;
    }
  }
  if (own.mine) args.moments[own.slot] = moments;
}

// Sixteen threads add up the moments of a Gaussian's instances, in the order of their slots.
__global__ void sum_kernel(BlendGradientInputs args) {
  const int64_t i = global_thread() / kMoments;
  const int k = int(threadIdx.x) % kMoments;
  if (i >= args.visible) return;
  float sum = 0;
  for (uint32_t slot = args.slot_start[i]; slot < args.slot_start[i + 1]; ++slot) sum += args.moments[slot].of[k];
  args.totals[int64_t(args.order[i]) * kMoments + k] += sum;
}

void sorted_backward(const Queue &queue, const BlendGradientInputs &args, int tiles) {
  const bool flat = planar(args.forward.projection);
  const auto states = flat              ? states_kernel<true, false>
                      : args.grad_rays ? states_kernel<false, true>
                                        : states_kernel<false, false>;
  launch(states, blocks_of(args.forward.table), kBatch, queue, args);
  const int64_t threads = buckets_at_most(args.instances, tiles) * kWarp;
  launch(flat ? buckets_kernel<true> : buckets_kernel<false>, blocks_for(threads, kBucketThreads), kBucketThreads,
         queue, args, tiles);
}

}  // namespace
}  // namespace padgs

using namespace padgs;

PADGS_API int padgs_cuda_blend_backward(const Queue *queue, const BlendGradientInputs *args, int32_t tiles) {
  return on_device(*queue, [&] {
    if (args->forward.core_size)
      hybrid_backward(*queue, *args, tiles);
    else
      sorted_backward(*queue, *args, tiles);
    launch(sum_kernel, blocks_for(args->visible, kGaussiansPerBlock), kGaussiansPerBlock * kMoments, *queue, *args);
    return 0;
  });
}
