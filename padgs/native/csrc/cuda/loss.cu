// The photometric loss (Eq. 16) and its derivative by the image: L1 and SSIM under a weight map. Two passes, each of
// which blurs a block of pixels and what surrounds it in shared memory; loss.cpp of the CPU library says why two are
// enough.
#include "arguments.h"
#include "device.cuh"

namespace padgs {
namespace {

constexpr int kHalf = 5, kSide = 16, kHalo = kSide + 2 * kHalf;  // the window is 11 pixels long, sigma 1.5
constexpr int kThreads = kSide * kSide;
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
  int x0, y0, x, y;  // of the block, and of the thread
  bool inside;
};
__device__ LossPlace loss_place(const LossArguments &args) {
  const int across = (args.width + kSide - 1) / kSide, thread = int(threadIdx.x);
  LossPlace p{int(blockIdx.x) % across * kSide, int(blockIdx.x) / across * kSide, 0, 0, false};
  p.x = p.x0 + thread % kSide, p.y = p.y0 + thread / kSide;
  p.inside = p.x < args.width && p.y < args.height;
  return p;
}

// Whether an entry of the block with its halo lies in the image, and where.
__device__ bool halo_pixel(const LossArguments &args, const LossPlace &p, int entry, int64_t &pixel) {
  const int x = p.x0 - kHalf + entry % kHalo, y = p.y0 - kHalf + entry / kHalo;
  pixel = int64_t(y) * args.width + x;
  return x >= 0 && x < args.width && y >= 0 && y < args.height;
}

// Means of kMaps maps under the window, at the thread's own pixel. `values` gives the maps of an entry of the halo.
template <int kMaps, class Values>
__device__ void window_means(float (*rows)[kHalo][kSide], Values values, float *means) {
  const int thread = int(threadIdx.x);
  for (int item = thread; item < kHalo * kSide; item += kThreads) {
    const int row = item / kSide, column = item % kSide;
    float sums[kMaps] = {};
    for (int k = -kHalf; k <= kHalf; ++k) {
      float at[kMaps];
      values(row * kHalo + column + kHalf + k, at);
      for (int map = 0; map < kMaps; ++map) sums[map] += tap(distance(k)) * at[map];
    }
    for (int map = 0; map < kMaps; ++map) rows[map][row][column] = sums[map];
  }
  __syncthreads();
  const int row = thread / kSide + kHalf, column = thread % kSide;
  for (int map = 0; map < kMaps; ++map) {
    float sum = 0;
    for (int k = -kHalf; k <= kHalf; ++k) sum += tap(distance(k)) * rows[map][row + k][column];
    means[map] = sum;
  }
}

__device__ float weight_at(const LossArguments &args, const LossPlace &p) {
  return p.inside ? args.weight[p.y * args.weight_row_stride + p.x * args.weight_column_stride] : 0.0f;
}

__global__ void __launch_bounds__(kThreads) compare_kernel(DeviceLossArguments device) {
  __shared__ float image[kHalo * kHalo], target[kHalo * kHalo], rows[5][kHalo][kSide];
  __shared__ float sums[kThreads / kWarp];
  const LossArguments &args = device.loss;
  const LossPlace p = loss_place(args);
  const float w = weight_at(args, p), share = (1 - args.lambda_l1) / *device.total;
  float loss = 0;
  for (int channel = 0; channel < kChannels; ++channel) {
    __syncthreads();  // nobody reads the last channel any more
    for (int entry = int(threadIdx.x); entry < kHalo * kHalo; entry += kThreads) {
      int64_t pixel;
      const bool inside = halo_pixel(args, p, entry, pixel);
      image[entry] = inside ? args.image[kChannels * pixel + channel] : 0.0f;
      target[entry] = inside ? args.target[kChannels * pixel + channel] : 0.0f;
    }
    __syncthreads();
    float m[5];
    window_means<5>(rows, [&](int entry, float *at) {
      const float x = image[entry], t = target[entry];
      at[0] = x, at[1] = t, at[2] = x * x, at[3] = t * t, at[4] = x * t;
    }, m);
    const float xx = m[2] - m[0] * m[0], tt = m[3] - m[1] * m[1], xt = m[4] - m[0] * m[1];
    const float a1 = 2 * m[0] * m[1] + kC1, a2 = 2 * xt + kC2;
    const float b1 = m[0] * m[0] + m[1] * m[1] + kC1, b2 = xx + tt + kC2;
    const float inverse = 1 / (b1 * b2), similarity = a1 * a2 * inverse;
    const int own = (int(threadIdx.x) / kSide + kHalf) * kHalo + int(threadIdx.x) % kSide + kHalf;
    loss += w * (args.lambda_l1 * magnitude(image[own] - target[own]) + (1 - args.lambda_l1) * (1 - similarity));
    if (!args.gradient || !p.inside) continue;
    // dS/d(m_x), dS/d(E[x^2]), dS/d(E[x t]), with the variances written as differences.
    const float scale = -w * share;
    const int64_t size = int64_t(args.width) * args.height * kChannels;
    float *out = args.workspace + kChannels * (int64_t(p.y) * args.width + p.x) + channel;
    out[0] = scale * 2 * (m[1] * (a2 - a1) * inverse - m[0] * similarity * (1 / b1 - 1 / b2));
    out[size] = -scale * similarity / b2;
    out[2 * size] = scale * 2 * a1 * inverse;
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
  __shared__ float partials[3][kHalo * kHalo], rows[3][kHalo][kSide];
  const LossArguments &args = device.loss;
  const LossPlace p = loss_place(args);
  const int64_t size = int64_t(args.width) * args.height * kChannels;
  const float w = weight_at(args, p) * args.lambda_l1 / *device.total;
  for (int channel = 0; channel < kChannels; ++channel) {
    __syncthreads();
    for (int entry = int(threadIdx.x); entry < kHalo * kHalo; entry += kThreads) {
      int64_t pixel;
      const bool inside = halo_pixel(args, p, entry, pixel);
      for (int map = 0; map < 3; ++map)
        partials[map][entry] = inside ? args.workspace[map * size + kChannels * pixel + channel] : 0.0f;
    }
    __syncthreads();
    float blurred[3];
    window_means<3>(rows, [&](int entry, float *at) {
      for (int map = 0; map < 3; ++map) at[map] = partials[map][entry];
    }, blurred);
    if (!p.inside) continue;
    const int64_t own = kChannels * (int64_t(p.y) * args.width + p.x) + channel;
    const float x = args.image[own], t = args.target[own], sign = x > t ? w : x < t ? -w : 0.0f;
    args.gradient[own] = blurred[0] + 2 * x * blurred[1] + t * blurred[2] + sign;
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
