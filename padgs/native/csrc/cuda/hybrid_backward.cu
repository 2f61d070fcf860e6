// Hybrid blending, backward. The derivative of a fragment needs its pixel's core and the sums over its tail, which the
// forward pass kept, but no other fragment: first a thread for each pixel turns the core into what derivatives need,
// then a warp takes a bucket, a lane for each instance, and all lanes visit one pixel after the other. Every instance
// sums its own moments in registers, as in sorted blending.
#include "blend.cuh"

namespace padgs {
namespace {

constexpr float kNearlyInCore = 0.999f * kCoreAlphaMin;  // for rounding, which may differ from that of the forward pass

__device__ float signal_of(const Upstream &up, float offset, float red, float green, float blue, float depth) {
  return up.red * red + up.green * green + up.blue * blue + up.depth * depth + offset;
}

template <bool kPlanar>
__global__ void __launch_bounds__(kBatch) differentiate_kernel(BlendGradientInputs args) {
  typedef typename PixelOf<kPlanar>::Type Pixel;
  const BlendInputs &forward = args.forward;
  const PixelPlace place = pixel_place(forward.table, blockIdx.x, int(threadIdx.x));
  if (!place.inside) return;
  const int64_t p = place.index;
  const int32_t *core = forward.core + p * forward.core_size;
  CoreGradient *gradients = args.core_gradients + p * forward.core_size;
  const Tail tail = forward.tails[p];
  const Pixel pixel(forward.rays, forward.wrap, forward.table.width, place.x, place.y);
  Upstream up;
  const float grad_t = load_upstream(args, p, up);

  float left = 1, coverage = 0;
  int filled = 0;
  for (; filled < forward.core_size && core[filled] >= 0; ++filled) {
    const float alpha = smaller(exp2f(pixel.at(forward.footprints[core[filled]]).log2_alpha), kAlphaMax);
    const float weight = alpha * left;
    gradients[filled] = {left, weight};
    coverage += weight;
    left = left_behind(left, weight);
  }
  TailGradient out{left * tail.opacity_per_alpha(), 0.0f, 0.0f, 0.0f};
  coverage += out.unit * tail.alpha;
  if (args.grad_depth && coverage > 0) {
    up.depth = args.grad_depth[p] / coverage;
    out.offset = -(up.depth * forward.depth[p]);
  }
  if (tail.alpha > 0) {
    const float each = 1.0f / tail.alpha;
    out.mean = signal_of(up, out.offset, each * tail.red, each * tail.green, each * tail.blue, each * tail.depth);
  }
  out.behind = left * tail.left * (grad_t - out.mean);
  float behind = out.unit * tail.alpha * out.mean + left * tail.left * grad_t;
  for (int k = filled - 1; k >= 0; --k) {
    const Footprint &f = forward.footprints[core[k]];
    const float weight = gradients[k].behind;
    gradients[k].behind = behind;
    behind += weight * signal_of(up, out.offset, f.red, f.green, f.blue, f.depth);
  }
  args.upstream[p] = up;
  args.tail_gradients[p] = out;
}

// One pair. Returns M = dL/d(ln alpha).
__device__ float differentiate(const BlendGradientInputs &args, const Footprint &f, int32_t gaussian, float log2_alpha,
                               int64_t p, const Upstream &up, float &weight) {
  const BlendInputs &forward = args.forward;
  const float full = exp2f(log2_alpha), alpha = smaller(full, kAlphaMax);
  const TailGradient tail = args.tail_gradients[p];
  float unit = tail.unit, mean = tail.mean, behind = tail.behind;
  if (alpha >= kNearlyInCore) {
    const int64_t core = p * forward.core_size;
    for (int k = 0; k < forward.core_size; ++k) {
      const int32_t found = forward.core[core + k];
      if (found == gaussian) {
        const CoreGradient gradient = args.core_gradients[core + k];
        unit = gradient.unit, mean = 0, behind = gradient.behind;
      }
      if (found == gaussian || found < 0) break;
    }
  }
  weight = alpha * unit;
  const float signal = signal_of(up, tail.offset, f.red, f.green, f.blue, f.depth) - mean;
  return full < kAlphaMax ? weight * signal - behind * (alpha * quick_inverse(1.0f - alpha)) : 0.0f;
}

template <bool kPlanar>
__global__ void __launch_bounds__(kBucketThreads) hybrid_buckets_kernel(BlendGradientInputs args, int tiles) {
  typedef typename PixelOf<kPlanar>::Type Pixel;
  const BlendInputs &forward = args.forward;
  const TileTable &table = forward.table;
  BucketLane own;
  if (!take_bucket(forward, args.instances, tiles, own)) return;
  const Reach &reach = own.reach;
  const Footprint &f = own.footprint;
  Moments moments{};
  float *sums = moments.of;

  for (int chunk = 0; chunk < 1 << own.level && own.column + chunk < chunks(table.width); ++chunk) {
    const bool active = own.mine && reach.chunk <= chunk && chunk < reach.chunk_end;
    int top, bottom;
    rows_of_warp(active, reach, top, bottom);
    const int x0 = (own.column + chunk) * kTile, x_end = least(x0 + kTile, table.width);
    for (int row = top; row < bottom; ++row) {
      if (!active || row < reach.row || row >= reach.row_end) continue;
      const int y = own.row * kTile + row;
      for (int x = x0; x < x_end; ++x) {
        const Pixel pixel(forward.rays, forward.wrap, table.width, x, y);
        const typename Pixel::Pair pair = pixel.at(f);
        if (!pair.reached) continue;
        const int64_t p = int64_t(y) * table.width + x;
        const Upstream up = args.upstream[p];
        float weight;
        const float m = differentiate(args, f, reach.gaussian, pair.log2_alpha, p, up, weight);
        pair.add(m, sums);
        if (args.absolute) sums[kAbsoluteMoment] += pair.pull(f, m);
        sums[10] += weight * up.red;
        sums[11] += weight * up.green;
        sums[12] += weight * up.blue;
        sums[13] += weight * up.depth;
      }
    }
  }
  if (own.mine) args.moments[own.slot] = moments;
}

// Gradients of a table of rays: a thread for each pixel reads the list once more.
__global__ void __launch_bounds__(kBatch) hybrid_rays_kernel(BlendGradientInputs args) {
  __shared__ Batch batch;
  const BlendInputs &forward = args.forward;
  const PixelPlace place = pixel_place(forward.table, blockIdx.x, int(threadIdx.x));
  const int begin = forward.tile_start[place.chunk.tile], end = forward.tile_start[place.chunk.tile + 1];
  const int y = place.y - place.chunk.y0, row = place.inside ? place.y : 0, column = place.inside ? place.x : 0;
  const ProjectivePixel pixel(forward.rays, forward.wrap, forward.table.width, column, row);
  const Upstream up = place.inside ? args.upstream[place.index] : Upstream{};
  Vec3<float> sum{0, 0, 0};
  for (int first = begin; first < end; first += kBatch) {
    __syncthreads();
    const int total = fill(batch, forward, place.chunk, begin, first, end);
    for (int k = 0; k < total && place.inside; ++k) {
      const Reach reach = batch.reaches[k];
      if (y < reach.row || y >= reach.row_end) continue;
      const Footprint &f = batch.footprints[k];
      const ProjectivePair pair = pixel.at(f);
      if (!pair.reached) continue;
      float weight;
      const float m = differentiate(args, f, reach.gaussian, pair.log2_alpha, place.index, up, weight);
      sum = sum + pixel.ray_gradient(f, pair, m);
    }
  }
  if (place.inside) write_ray_gradient(args, place, sum);
}

}  // namespace

void hybrid_backward(const Queue &queue, const BlendGradientInputs &args, int tiles) {
  const bool flat = planar(args.forward.projection);
  const int64_t blocks = blocks_of(args.forward.table), warps = buckets_at_most(args.instances, tiles);
  launch(flat ? differentiate_kernel<true> : differentiate_kernel<false>, blocks, kBatch, queue, args);
  if (args.grad_rays) launch(hybrid_rays_kernel, blocks, kBatch, queue, args);
  launch(flat ? hybrid_buckets_kernel<true> : hybrid_buckets_kernel<false>, blocks_for(warps * kWarp, kBucketThreads),
         kBucketThreads, queue, args, tiles);
}

}  // namespace padgs
