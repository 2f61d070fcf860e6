// The part of CUDA that the kernels use, so that the same sources also compile for the host: with PADGS_EMULATED a block's
// threads run in turns on one CPU thread (tests/render/cuda/emulation.h), which is how machines without a GPU test them.
#pragma once

#include <cstdint>

#if defined(PADGS_EMULATED)
#include "emulation.h"
#else
#include <cuda_runtime.h>
#endif

namespace padgs {

constexpr int kWarp = 32;
constexpr unsigned kAllLanes = 0xffffffffu;

// Where work goes.
struct Queue {
  int32_t device;
  void *stream;
};

#if defined(PADGS_EMULATED)

template <class... P, class... A>
void launch(void (*kernel)(P...), int64_t blocks, int threads, const Queue &, A... arguments) {
  emulate(unsigned(blocks), unsigned(threads), [=] { kernel(arguments...); });
}
inline float quick_inverse(float x) { return 1.0f / x; }
inline float quick_exp2(float x) { return exp2f(x); }

#else

template <class... P, class... A>
void launch(void (*kernel)(P...), int64_t blocks, int threads, const Queue &queue, A... arguments) {
  if (blocks > 0) kernel<<<unsigned(blocks), threads, 0, cudaStream_t(queue.stream)>>>(arguments...);
}
// To the last bit but one, without detours for the smallest numbers, for which they give or take 0.
__device__ inline float quick_inverse(float x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ inline float quick_exp2(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

#endif

// Does work that launches kernels and returns an error or 0, on the queue's device; the thread's own device, which torch
// chose, is then what it was. Returns the work's error, or that of its launches, and leaves none behind: the next call
// would be blamed for it.
template <class Work>
int on_device(const Queue &queue, Work work) {
  int before = queue.device;
  int error = int(cudaGetDevice(&before));
  if (!error && before != queue.device) error = int(cudaSetDevice(queue.device));
  if (!error) error = work();
  const int launched = int(cudaGetLastError());
  if (before != queue.device) cudaSetDevice(before);
  return error ? error : launched;
}

inline int64_t blocks_for(int64_t items, int per_block) { return (items + per_block - 1) / per_block; }

__device__ inline int64_t global_thread() { return int64_t(blockIdx.x) * blockDim.x + threadIdx.x; }
__device__ inline int lane_index() { return int(threadIdx.x) % kWarp; }

// Over a whole warp, all of whose lanes must take part; in a fixed order, so that sums of floats are reproducible.
template <class T>
__device__ T warp_sum(T value) {
  for (int step = kWarp / 2; step; step /= 2) value += __shfl_xor_sync(kAllLanes, value, step);
  return value;
}
template <class T>
__device__ T warp_max(T value) {
  for (int step = kWarp / 2; step; step /= 2) {
    const T other = __shfl_xor_sync(kAllLanes, value, step);
    value = other > value ? other : value;
  }
  return value;
}

// Several sums over a warp at once: a lane returns the one that `dealt_index` names. With every step the lanes split, and
// each half goes on with half of the values, so that 16 sums take 16 exchanges rather than 80.
template <int kCount, int kStep = kWarp / 2>
__device__ float dealt_sum(const float (&values)[kCount]) {
  if constexpr (kCount == 1) {
    float total = values[0];
    for (int step = kStep; step; step /= 2) total += __shfl_xor_sync(kAllLanes, total, step);
    return total;
  } else {
    constexpr int kHalf = (kCount + 1) / 2;
    const bool upper = lane_index() & kStep;
    float kept[kHalf];
    for (int k = 0; k < kHalf; ++k) {
      const float low = values[k], high = k + kHalf < kCount ? values[k + kHalf] : 0.0f;
      kept[k] = (upper ? high : low) + __shfl_xor_sync(kAllLanes, upper ? low : high, kStep);
    }
    return dealt_sum<kHalf, kStep / 2>(kept);
  }
}
// Which of `count` <= 16 values a lane has the sum of; -1 where it has none, or another lane's.
__device__ inline int dealt_index(int count, int lane) {
  int index = 0, here = count, step = kWarp / 2;  // values of the lane's half, without padding
  for (int size = count; size > 1; step /= 2) {
    const int half = (size + 1) / 2;
    const bool upper = lane & step;
    index += upper ? half : 0;
    here = upper ? here - half : here < half ? here : half;
    size = half;
  }
  return here > 0 && lane % (2 * step) == 0 ? index : -1;
}

}  // namespace padgs
