// Matrix products of a warp on tensor cores, which begin with compute capability 8.0: A [16, 16] times B [16, 8] in
// bfloat16 or float16, summed in float32. Fragments, the part of a matrix in a lane, are those of PTX's
// mma.m16n8k16. With lane = 4 group + thread, their numbers are
//   A  (row, column): 4 pairs of columns 2 thread and 2 thread + 1, of rows group and group + 8, then 8 columns further on
//   B  (row, column): 2 pairs of rows 2 thread and 2 thread + 1 of column group, then 8 rows further on
//   sums  rows group and group + 8 of columns 2 thread and 2 thread + 1
#pragma once

#include "device.cuh"

namespace padgs {

struct alignas(16) FragmentA {
  uint32_t pairs[4];
};
struct alignas(8) FragmentB {
  uint32_t pairs[2];
};
struct Sums {
  float of[4];
};

struct Bfloat16 {};
struct Float16 {};

}  // namespace padgs

#if defined(PADGS_EMULATED)
#include "mma_emulation.h"
#else
#include <cuda_bf16.h>
#include <cuda_fp16.h>

namespace padgs {

__device__ inline uint32_t packed(float low, float high, Bfloat16) {
  const __nv_bfloat162 pair = __floats2bfloat162_rn(low, high);
  return reinterpret_cast<const uint32_t &>(pair);
}
__device__ inline uint32_t packed(float low, float high, Float16) {
  const __half2 pair = __floats2half2_rn(low, high);
  return reinterpret_cast<const uint32_t &>(pair);
}
__device__ inline float2 unpacked(uint32_t pair, Bfloat16) {
  return __bfloat1622float2(reinterpret_cast<const __nv_bfloat162 &>(pair));
}
__device__ inline float2 unpacked(uint32_t pair, Float16) {
  return __half22float2(reinterpret_cast<const __half2 &>(pair));
}

// Not called on older capabilities; `padgs_cuda_networks_fit` guarantees it.
#if __CUDA_ARCH__ >= 800
#define PADGS_MMA(type)                                                                                            \
  asm volatile("mma.sync.aligned.m16n8k16.row.col.f32." type "." type ".f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, " \
               "{%0,%1,%2,%3};"                                                                                      \
               : "+f"(sums.of[0]), "+f"(sums.of[1]), "+f"(sums.of[2]), "+f"(sums.of[3])                              \
               : "r"(a.pairs[0]), "r"(a.pairs[1]), "r"(a.pairs[2]), "r"(a.pairs[3]), "r"(b.pairs[0]), "r"(b.pairs[1]))
#define PADGS_MOVMATRIX asm volatile("movmatrix.sync.aligned.m8n8.trans.b16 %0, %1;" : "=r"(result) : "r"(pair))
#else
#define PADGS_MMA(type) __trap()
#define PADGS_MOVMATRIX __trap()
#endif

// Adds a product of matrices to sums.
__device__ inline void multiply_add(Sums &sums, const FragmentA &a, const FragmentB &b, Bfloat16) { PADGS_MMA("bf16"); }
__device__ inline void multiply_add(Sums &sums, const FragmentA &a, const FragmentB &b, Float16) { PADGS_MMA("f16"); }

// Of an 8x8 matrix of 16-bit numbers: row group, columns 2 thread and 2 thread + 1 in, those of its transpose out.
__device__ inline uint32_t transposed(uint32_t pair) {
  uint32_t result = 0;
  PADGS_MOVMATRIX;
  return result;
}
#undef PADGS_MMA
#undef PADGS_MOVMATRIX

}  // namespace padgs
#endif

namespace padgs {

// Numbers rounded to a type.
template <class T>
__device__ void round_to(Sums &sums) {
  for (int i = 0; i < 4; i += 2) {
    const float2 pair = unpacked(packed(sums.of[i], sums.of[i + 1], T{}), T{});
    sums.of[i] = pair.x, sums.of[i + 1] = pair.y;
  }
}

// Sums [16, 8] left and right as the factor A [16, 16] of the next product.
template <class T>
__device__ FragmentA as_factor(const Sums &left, const Sums &right) {
  return {packed(left.of[0], left.of[1], T{}), packed(left.of[2], left.of[3], T{}),
          packed(right.of[0], right.of[1], T{}), packed(right.of[2], right.of[3], T{})};
}

__device__ inline FragmentA transposed(const FragmentA &a) {
  return {transposed(a.pairs[0]), transposed(a.pairs[2]), transposed(a.pairs[1]), transposed(a.pairs[3])};
}

// The first or second eight columns, as a factor B, of the matrix whose transpose is given.
__device__ inline FragmentB columns_of(const FragmentA &transpose, int half) {
  return {transpose.pairs[half], transpose.pairs[half + 2]};
}

}  // namespace padgs
