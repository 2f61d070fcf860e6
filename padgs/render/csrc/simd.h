// Sixteen floats at a time, with the same few operations on every instruction set.
//
// AVX-512 uses its mask registers; everything else uses GCC/Clang vector extensions, which the compiler splits into
// the width that the machine has. Lanes are the 16 pixels of one tile row, or 16 independent items.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace padgs {
namespace PADGS_ISA {

constexpr int kLanes = 16;
typedef float Vec __attribute__((vector_size(64), aligned(64)));
typedef int32_t VecI __attribute__((vector_size(64), aligned(64)));

static inline Vec splat(float x) { return x - Vec{}; }
static inline VecI splat_int(int32_t x) { return x - VecI{}; }
static inline Vec iota() { return Vec{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}; }
static inline Vec load(const float *p) { Vec v; std::memcpy(&v, p, sizeof v); return v; }
static inline void store(float *p, Vec v) { std::memcpy(p, &v, sizeof v); }
static inline VecI load_int(const int32_t *p) { VecI v; std::memcpy(&v, p, sizeof v); return v; }
static inline void store_int(int32_t *p, VecI v) { std::memcpy(p, &v, sizeof v); }

#if defined(__AVX512F__)

typedef __mmask16 Mask;
static inline __m512 raw(Vec v) { return (__m512)v; }
static inline Mask less(Vec a, Vec b) { return _mm512_cmp_ps_mask(raw(a), raw(b), _CMP_LT_OQ); }
static inline Mask at_least(Vec a, Vec b) { return _mm512_cmp_ps_mask(raw(a), raw(b), _CMP_GE_OQ); }
static inline Mask at_most(VecI a, VecI b) { return _mm512_cmple_epi32_mask((__m512i)a, (__m512i)b); }
static inline Mask both(Mask a, Mask b) { return a & b; }
static inline Mask without(Mask a, Mask b) { return a & ~b; }
static inline bool any(Mask m) { return m != 0; }
static inline int count(Mask m) { return __builtin_popcount(m); }
static inline Vec select(Mask m, Vec a, Vec b) { return (Vec)_mm512_mask_blend_ps(m, raw(b), raw(a)); }
static inline VecI select_int(Mask m, VecI a, VecI b) {
  return (VecI)_mm512_mask_blend_epi32(m, (__m512i)b, (__m512i)a);
}
static inline Vec minimum(Vec a, Vec b) { return (Vec)_mm512_min_ps(raw(a), raw(b)); }
static inline Vec maximum(Vec a, Vec b) { return (Vec)_mm512_max_ps(raw(a), raw(b)); }
static inline Vec round_nearest(Vec a) { return (Vec)_mm512_roundscale_ps(raw(a), 0); }
static inline Vec round_down(Vec a) { return (Vec)_mm512_roundscale_ps(raw(a), 1); }
static inline Vec scale_by_power(Vec a, Vec n) { return (Vec)_mm512_scalef_ps(raw(a), raw(n)); }

#else

typedef VecI Mask;
static inline Mask less(Vec a, Vec b) { return a < b; }
static inline Mask at_least(Vec a, Vec b) { return a >= b; }
static inline Mask at_most(VecI a, VecI b) { return a <= b; }
static inline Mask both(Mask a, Mask b) { return a & b; }
static inline Mask without(Mask a, Mask b) { return a & ~b; }
static inline uint32_t bits(Mask m) {
#if defined(__AVX2__)
  __m256i halves[2];
  std::memcpy(halves, &m, sizeof m);
  return uint32_t(_mm256_movemask_ps(_mm256_castsi256_ps(halves[0]))) |
         uint32_t(_mm256_movemask_ps(_mm256_castsi256_ps(halves[1]))) << 8;
#elif defined(__SSE2__)
  __m128i quarters[4];
  std::memcpy(quarters, &m, sizeof m);
  uint32_t result = 0;
  for (int i = 0; i < 4; ++i) result |= uint32_t(_mm_movemask_ps(_mm_castsi128_ps(quarters[i]))) << (4 * i);
  return result;
#else
  uint32_t result = 0;
  for (int i = 0; i < kLanes; ++i) result |= uint32_t(m[i] != 0) << i;
  return result;
#endif
}
static inline bool any(Mask m) { return bits(m) != 0; }
static inline int count(Mask m) { return __builtin_popcount(bits(m)); }
static inline Vec select(Mask m, Vec a, Vec b) { return (Vec)(((VecI)a & m) | ((VecI)b & ~m)); }
static inline VecI select_int(Mask m, VecI a, VecI b) { return (a & m) | (b & ~m); }
static inline Vec minimum(Vec a, Vec b) { return select(a < b, a, b); }
static inline Vec maximum(Vec a, Vec b) { return select(a > b, a, b); }
// Adding and subtracting 1.5 * 2^23 rounds to the nearest integer; right for |a| < 2^22, which is all we have.
static inline Vec round_nearest(Vec a) { return (a + 12582912.0f) - 12582912.0f; }
static inline Vec round_down(Vec a) {
  Vec n = round_nearest(a);
  return n - select(n > a, splat(1.0f), Vec{});
}
static inline Vec scale_by_power(Vec a, Vec n) {
  VecI exponent;
  Vec shifted = n + 12582912.0f;  // the integer is now in the low mantissa bits
  std::memcpy(&exponent, &shifted, sizeof shifted);
  VecI result;
  std::memcpy(&result, &a, sizeof a);
  result += exponent << 23;
  Vec scaled;
  std::memcpy(&scaled, &result, sizeof result);
  return scaled;
}

#endif

static inline Vec keep(Mask m, Vec a) { return select(m, a, Vec{}); }

// Sum of all lanes by halving.
static inline float sum(Vec v) {
  typedef float Half __attribute__((vector_size(32)));
  typedef float Quarter __attribute__((vector_size(16)));
  Half h = __builtin_shufflevector(v, v, 0, 1, 2, 3, 4, 5, 6, 7) +
           __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15);
  Quarter q = __builtin_shufflevector(h, h, 0, 1, 2, 3) + __builtin_shufflevector(h, h, 4, 5, 6, 7);
  q += __builtin_shufflevector(q, q, 2, 3, 0, 1);
  return q[0] + q[1];
}

// 2^x to 2.3e-7 relative for x in [-100, 100]: 2^round(x) times a degree-5 minimax polynomial of the rest.
static inline Vec exp2_fast(Vec x) {
  Vec n = round_nearest(x);
  Vec r = x - n;
  Vec p = r * 0.0013276471f + 0.0096755419f;
  p = p * r + 0.0555071309f;
  p = p * r + 0.2402212024f;
  p = p * r + 0.6931469440f;
  p = p * r + 1.0f;
  return scale_by_power(p, n);
}

}  // namespace PADGS_ISA
}  // namespace padgs
