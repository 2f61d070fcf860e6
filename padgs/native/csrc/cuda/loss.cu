// The photometric loss (Eq. 16) and its derivative by the image: L1 and SSIM under a weight map. Two passes, each of
// which blurs a block of pixels and its margin in shared memory; loss.cpp of the CPU library says why two are
// enough.
#include "arguments.h"
#include "device.cuh"

namespace padgs {
namespace {

constexpr int kHalf = 5, kSide = 32, kHalo = kSide + 2 * kHalf;  // the window is 11 pixels long, sigma 1.5
constexpr int kEach = 4;  // neighbouring pixels of a thread, which share the reads of their margin
constexpr int kThreads = kSide * kSide / kEach;
// Odd, so that threads next to each other may read columns as well as rows: 32 addresses then lie in 32 banks.
constexpr int kPitch = kHalo + 1, kRowPitch = kSide + 1;
constexpr int kEntries = kHalo * kPitch;
constexpr int kChannels = 3;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;

// exp(-k^2 / (2 sigma^2)) by distance from the centre, normalised.
__device__ float tap(int distance) {
  const float taps[kHalf + 1] = {0.26601172486f, 0.21300553771f, 0.10936068951f,
                                 0.03600077213f, 0.00759875814f, 0.00102838008f};
  return taps[distance];
}
__device__ int distance(int k) { return k < 0 ? -k : k; }

struct LossPlace {
  int x0, y0;       // of the block
  int column, row;  // of the thread's first pixel in it; the others are below

  __device__ int x() const { return x0 + column; }
  __device__ int y(int each) const { return y0 + row + each; }
  __device__ int own(int each) const { return (row + each + kHalf) * kPitch + column + kHalf; }
};
__device__ LossPlace loss_place(const LossArguments &args) {
  const int across = (args.width + kSide - 1) / kSide, thread = int(threadIdx.x);
  return {int(blockIdx.x) % across * kSide, int(blockIdx.x) / across * kSide, thread % kSide, thread / kSide * kEach};
}

// Whether an entry of the block with its halo lies in the image, and where.
__device__ bool halo_pixel(const LossArguments &args, const LossPlace &p, int entry, int64_t &pixel) {
  const int x = p.x0 - kHalf + entry % kPitch, y = p.y0 - kHalf + entry / kPitch;
  pixel = int64_t(y) * args.width + x;
  return x >= 0 && x < args.width && y >= 0 && y < args.height;
}

// Adds the k-th of the kEach + 10 values that surround kEach neighbours to the sums of those whose window it is in.
__device__ void add_to_windows(int k, float value, float *sums) {
  for (int each = 0; each < kEach; ++each)
    if (distance(k - kHalf - each) <= kHalf) sums[each] += tap(distance(k - kHalf - each)) * value;
}

// Means of kMaps maps under the window, at the thread's own pixels. `values` gives the maps of an entry of the halo.
template <int kMaps, class Values>
__device__ void window_means(float (*rows)[kHalo][kRowPitch], Values values, float (*means)[kEach]) {
  const int thread = int(threadIdx.x);
  for (int item = thread; item < kHalo * kSide / kEach; item += kThreads) {
    const int row = item % kHalo, column = item / kHalo * kEach;
    float sums[kMaps][kEach] = {};
#pragma unroll
    for (int k = 0; k < kEach + 2 * kHalf; ++k) {
      float at[kMaps];
      values(row * kPitch + column + k, at);
      for (int map = 0; map < kMaps; ++map) add_to_windows(k, at[map], sums[map]);
    }
    for (int map = 0; map < kMaps; ++map)
      for (int each = 0; each < kEach; ++each) rows[map][row][column + each] = sums[map][each];
  }
  __syncthreads();
  const int first = thread / kSide * kEach, column = thread % kSide;
  for (int map = 0; map < kMaps; ++map) {
    float sums[kEach] = {};
#pragma unroll
    for (int k = 0; k < kEach + 2 * kHalf; ++k) add_to_windows(k, rows[map][first + k][column], sums);
    for (int each = 0; each < kEach; ++each) means[map][each] = sums[each];
  }
}

// The pixel of the image, or -1 outside of it.
__device__ int64_t pixel_of(const LossArguments &args, const LossPlace &p, int each) {
  return p.x() < args.width && p.y(each) < args.height ? int64_t(p.y(each)) * args.width + p.x() : -1;
}
__device__ float weight_at(const LossArguments &args, const LossPlace &p, int each) {
  return args.weight[p.y(each) * args.weight_row_stride + p.x() * args.weight_column_stride];
}

__global__ void __launch_bounds__(kThreads) compare_kernel(DeviceLossArguments device) {
  __shared__ float image[kEntries], target[kEntries], rows[5][kHalo][kRowPitch];
  __shared__ float sums[kThreads / kWarp];
  const LossArguments &args = device.loss;
  const LossPlace p = loss_place(args);
  const float share = (1 - args.lambda_l1) / *device.total;
  const int64_t size = int64_t(args.width) * args.height * kChannels;
  float loss = 0;
  for (int channel = 0; channel < kChannels; ++channel) {
    __syncthreads();  // before the channel is overwritten
    for (int entry = int(threadIdx.x); entry < kEntries; entry += kThreads) {
      int64_t pixel;
      const bool inside = halo_pixel(args, p, entry, pixel);
      image[entry] = inside ? args.image[kChannels * pixel + channel] : 0.0f;
      target[entry] = inside ? args.target[kChannels * pixel + channel] : 0.0f;
    }
    __syncthreads();
    float m[5][kEach];
    window_means<5>(rows, [&](int entry, float *at) {
      const float x = image[entry], t = target[entry];
      at[0] = x, at[1] = t, at[2] = x * x, at[3] = t * t, at[4] = x * t;
    }, m);
    for (int each = 0; each < kEach; ++each) {
      const int64_t pixel = pixel_of(args, p, each);
      if (pixel < 0) break;  // those below are outside, too
      const float w = weight_at(args, p, each), mx = m[0][each], mt = m[1][each];
      const float xx = m[2][each] - mx * mx, tt = m[3][each] - mt * mt, xt = m[4][each] - mx * mt;
      const float a1 = 2 * mx * mt + kC1, a2 = 2 * xt + kC2;
      const float b1 = mx * mx + mt * mt + kC1, b2 = xx + tt + kC2;
      const float inverse = 1 / (b1 * b2), similarity = a1 * a2 * inverse;
      const float difference = image[p.own(each)] - target[p.own(each)];
      loss += w * (args.lambda_l1 * magnitude(difference) + (1 - args.lambda_l1) * (1 - similarity));
      if (!args.gradient) continue;
      // dS/d(m_x), dS/d(E[x^2]), dS/d(E[x t]), with the variances written as differences.
      const float scale = -w * share;
      float *out = args.workspace + kChannels * pixel + channel;
      out[0] = scale * 2 * (mt * (a2 - a1) * inverse - mx * similarity * (1 / b1 - 1 / b2));
      out[size] = -scale * similarity / b2;
      out[2 * size] = scale * 2 * a1 * inverse;
    }
  }
  loss = warp_sum(loss);
  if (lane_index() == 0) sums[threadIdx.x / kWarp] = loss;
  __syncthreads();
  if (threadIdx.x) return;
  float total = 0;
  for (int warp = 0; warp < kThreads / kWarp; ++warp) total += sums[warp];
  device.block_sums[blockIdx.x] = total;
}

__global__ void __launch_bounds__(kThreads) gradient_kernel(DeviceLossArguments device) {
  __shared__ float partials[3][kEntries], rows[3][kHalo][kRowPitch];
  const LossArguments &args = device.loss;
  const LossPlace p = loss_place(args);
  const int64_t size = int64_t(args.width) * args.height * kChannels;
  const float share = args.lambda_l1 / *device.total;
  for (int channel = 0; channel < kChannels; ++channel) {
    __syncthreads();
    for (int entry = int(threadIdx.x); entry < kEntries; entry += kThreads) {
      int64_t pixel;
      const bool inside = halo_pixel(args, p, entry, pixel);
      for (int map = 0; map < 3; ++map)
        partials[map][entry] = inside ? args.workspace[map * size + kChannels * pixel + channel] : 0.0f;
    }
    __syncthreads();
    float blurred[3][kEach];
    window_means<3>(rows, [&](int entry, float *at) {
      for (int map = 0; map < 3; ++map) at[map] = partials[map][entry];
    }, blurred);
    for (int each = 0; each < kEach; ++each) {
      const int64_t pixel = pixel_of(args, p, each), own = kChannels * pixel + channel;
      if (pixel < 0) break;
      const float x = args.image[own], t = args.target[own], w = weight_at(args, p, each) * share;
      const float sign = x > t ? w : x < t ? -w : 0.0f;
      args.gradient[own] = blurred[0][each] + 2 * x * blurred[1][each] + t * blurred[2][each] + sign;
    }
  }
}

}  // namespace
}  // namespace padgs

using namespace padgs;

// Blocks of the passes, each of which leaves a partial sum of the loss.
PADGS_API int64_t padgs_cuda_loss_blocks(int32_t height, int32_t width) {
  return blocks_for(width, kSide) * blocks_for(height, kSide);
}

PADGS_API int padgs_cuda_photometric_loss(const Queue *queue, const DeviceLossArguments *args) {
  return on_device(*queue, [&] {
    const int64_t blocks = padgs_cuda_loss_blocks(args->loss.height, args->loss.width);
    launch(compare_kernel, blocks, kThreads, *queue, *args);
    if (args->loss.gradient) launch(gradient_kernel, blocks, kThreads, *queue, *args);
    return 0;
  });
}
