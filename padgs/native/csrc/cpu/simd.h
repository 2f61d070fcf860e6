// Sixteen floats at a time, with the same few operations on every instruction set.
//
// A Vec is one AVX-512 register, two AVX2 registers, or four of the 16-byte registers that every other machine has;
// GCC/Clang vector extensions do the arithmetic. Lanes are the 16 pixels of one patch of a tile, or 16 independent items.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace padgs {
namespace PADGS_ISA {

constexpr int kLanes = 16;
#if defined(__AVX512F__)
constexpr int kPartBytes = 64;
#elif defined(__AVX2__)
constexpr int kPartBytes = 32;
#else
constexpr int kPartBytes = 16;
#endif
constexpr int kParts = 64 / kPartBytes;
typedef float Part __attribute__((vector_size(kPartBytes)));
typedef int32_t PartI __attribute__((vector_size(kPartBytes)));

#define PADGS_ALWAYS_INLINE inline __attribute__((always_inline))
#define PADGS_INLINE static PADGS_ALWAYS_INLINE
#define PADGS_EACH_PART for (int i = 0; i < kParts; ++i)

struct Vec {
  Part p[kParts];
};
struct VecI {
  PartI p[kParts];
};

PADGS_INLINE Vec splat(float x) { Vec r; PADGS_EACH_PART r.p[i] = x - Part{}; return r; }
PADGS_INLINE VecI splat_int(int32_t x) { VecI r; PADGS_EACH_PART r.p[i] = x - PartI{}; return r; }
PADGS_INLINE Vec zero() { Vec r; PADGS_EACH_PART r.p[i] = Part{}; return r; }
PADGS_INLINE VecI zero_int() { VecI r; PADGS_EACH_PART r.p[i] = PartI{}; return r; }

// Register by register: GCC copies a whole Vec of two AVX2 registers by way of the stack, in pieces that its next load
// has to wait for.
#define PADGS_LANES(from) ((from) + i * (kLanes / kParts))
PADGS_INLINE Vec load(const float *from) {
  Vec r;
  PADGS_EACH_PART std::memcpy(&r.p[i], PADGS_LANES(from), kPartBytes);
  return r;
}
PADGS_INLINE VecI load_int(const int32_t *from) {
  VecI r;
  PADGS_EACH_PART std::memcpy(&r.p[i], PADGS_LANES(from), kPartBytes);
  return r;
}
PADGS_INLINE void store(float *to, Vec v) { PADGS_EACH_PART std::memcpy(PADGS_LANES(to), &v.p[i], kPartBytes); }
PADGS_INLINE void store_int(int32_t *to, VecI v) { PADGS_EACH_PART std::memcpy(PADGS_LANES(to), &v.p[i], kPartBytes); }
#undef PADGS_LANES

alignas(64) static const float kIota[kLanes] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
PADGS_INLINE Vec iota() { return load(kIota); }

#define PADGS_OPERATOR(op)                                                                              \
  PADGS_INLINE Vec operator op(Vec a, Vec b) { Vec r; PADGS_EACH_PART r.p[i] = a.p[i] op b.p[i]; return r; } \
  PADGS_INLINE Vec operator op(Vec a, float b) { Vec r; PADGS_EACH_PART r.p[i] = a.p[i] op b; return r; }    \
  PADGS_INLINE Vec operator op(float a, Vec b) { Vec r; PADGS_EACH_PART r.p[i] = a op b.p[i]; return r; }
PADGS_OPERATOR(+)
PADGS_OPERATOR(-)
PADGS_OPERATOR(*)
PADGS_OPERATOR(/)
#undef PADGS_OPERATOR
PADGS_INLINE Vec operator-(Vec a) { Vec r; PADGS_EACH_PART r.p[i] = -a.p[i]; return r; }
PADGS_INLINE Vec &operator+=(Vec &a, Vec b) { return a = a + b; }

#if defined(__AVX512F__)

typedef __mmask16 Mask;
PADGS_INLINE __m512 raw(Vec v) { return (__m512)v.p[0]; }
PADGS_INLINE Vec vec(__m512 v) { return {{(Part)v}}; }
PADGS_INLINE Mask less(Vec a, Vec b) { return _mm512_cmp_ps_mask(raw(a), raw(b), _CMP_LT_OQ); }
PADGS_INLINE Mask at_least(Vec a, Vec b) { return _mm512_cmp_ps_mask(raw(a), raw(b), _CMP_GE_OQ); }
PADGS_INLINE Mask at_most(VecI a, VecI b) { return _mm512_cmple_epi32_mask((__m512i)a.p[0], (__m512i)b.p[0]); }
PADGS_INLINE Mask both(Mask a, Mask b) { return a & b; }
PADGS_INLINE Mask either(Mask a, Mask b) { return a | b; }
PADGS_INLINE Mask without(Mask a, Mask b) { return a & ~b; }
PADGS_INLINE uint32_t bits(Mask m) { return m; }
PADGS_INLINE Mask lanes_of(uint32_t bits) { return Mask(bits); }
PADGS_INLINE bool any(Mask m) { return m != 0; }
PADGS_INLINE int count(Mask m) { return __builtin_popcount(m); }
PADGS_INLINE Vec select(Mask m, Vec a, Vec b) { return vec(_mm512_mask_blend_ps(m, raw(b), raw(a))); }
PADGS_INLINE VecI select_int(Mask m, VecI a, VecI b) {
  return {{(PartI)_mm512_mask_blend_epi32(m, (__m512i)b.p[0], (__m512i)a.p[0])}};
}
PADGS_INLINE Vec minimum(Vec a, Vec b) { return vec(_mm512_min_ps(raw(a), raw(b))); }
PADGS_INLINE Vec maximum(Vec a, Vec b) { return vec(_mm512_max_ps(raw(a), raw(b))); }
PADGS_INLINE Vec round_nearest(Vec a) { return vec(_mm512_roundscale_ps(raw(a), 0)); }
PADGS_INLINE Vec round_down(Vec a) { return vec(_mm512_roundscale_ps(raw(a), 1)); }
PADGS_INLINE Vec scale_by_power(Vec a, Vec n) { return vec(_mm512_scalef_ps(raw(a), raw(n))); }

// 1 / a to one unit in the last place or so, without the slow division.
PADGS_INLINE Vec reciprocal(Vec a) {
  const Vec guess = vec(_mm512_rcp14_ps(raw(a)));
  return guess + guess * (1.0f - a * guess);
}

#else

struct Mask {
  PartI p[kParts];
};
PADGS_INLINE Mask less(Vec a, Vec b) { Mask r; PADGS_EACH_PART r.p[i] = a.p[i] < b.p[i]; return r; }
PADGS_INLINE Mask at_least(Vec a, Vec b) { Mask r; PADGS_EACH_PART r.p[i] = a.p[i] >= b.p[i]; return r; }
PADGS_INLINE Mask at_most(VecI a, VecI b) { Mask r; PADGS_EACH_PART r.p[i] = a.p[i] <= b.p[i]; return r; }
PADGS_INLINE Mask both(Mask a, Mask b) { Mask r; PADGS_EACH_PART r.p[i] = a.p[i] & b.p[i]; return r; }
PADGS_INLINE Mask either(Mask a, Mask b) { Mask r; PADGS_EACH_PART r.p[i] = a.p[i] | b.p[i]; return r; }
PADGS_INLINE Mask without(Mask a, Mask b) { Mask r; PADGS_EACH_PART r.p[i] = a.p[i] & ~b.p[i]; return r; }
PADGS_INLINE uint32_t bits(Mask m) {
  uint32_t result = 0;
#if defined(__AVX2__)
  PADGS_EACH_PART result |= uint32_t(_mm256_movemask_ps((__m256)m.p[i])) << (8 * i);
#elif defined(__SSE2__)
  PADGS_EACH_PART result |= uint32_t(_mm_movemask_ps((__m128)m.p[i])) << (4 * i);
#else
  for (int lane = 0; lane < kLanes; ++lane) result |= uint32_t(m.p[lane / 4][lane % 4] != 0) << lane;
#endif
  return result;
}
alignas(64) static const int32_t kLaneBits[kLanes] = {1,   2,   4,    8,    16,   32,   64,    128,
                                                      256, 512, 1024, 2048, 4096, 8192, 16384, 32768};
PADGS_INLINE Mask lanes_of(uint32_t bits) {
  const VecI lane = load_int(kLaneBits);
  Mask r;
  PADGS_EACH_PART r.p[i] = (lane.p[i] & int32_t(bits)) != 0;
  return r;
}
PADGS_INLINE bool any(Mask m) { return bits(m) != 0; }
PADGS_INLINE int count(Mask m) { return __builtin_popcount(bits(m)); }
PADGS_INLINE Vec select(Mask m, Vec a, Vec b) {
  Vec r;
  PADGS_EACH_PART r.p[i] = (Part)(((PartI)a.p[i] & m.p[i]) | ((PartI)b.p[i] & ~m.p[i]));
  return r;
}
PADGS_INLINE VecI select_int(Mask m, VecI a, VecI b) {
  VecI r;
  PADGS_EACH_PART r.p[i] = (a.p[i] & m.p[i]) | (b.p[i] & ~m.p[i]);
  return r;
}
PADGS_INLINE Vec reciprocal(Vec a) { return 1.0f / a; }
PADGS_INLINE Vec minimum(Vec a, Vec b) { return select(less(a, b), a, b); }
PADGS_INLINE Vec maximum(Vec a, Vec b) { return select(less(a, b), b, a); }
// Adding and subtracting 1.5 * 2^23 rounds to the nearest integer; right for |a| < 2^22, which is all we have.
constexpr float kRounder = 12582912.0f;
PADGS_INLINE Vec round_nearest(Vec a) { return (a + kRounder) - kRounder; }
PADGS_INLINE Vec round_down(Vec a) {
  const Vec n = round_nearest(a);
  return n - select(less(a, n), splat(1.0f), zero());
}
// a * 2^n for integers n: once n + kRounder is formed, n sits in the low bits of the mantissa.
PADGS_INLINE Vec scale_by_power(Vec a, Vec n) {
  Vec r;
  PADGS_EACH_PART r.p[i] = (Part)((PartI)a.p[i] + ((PartI)(n.p[i] + kRounder) << 23));
  return r;
}

#endif

PADGS_INLINE Vec keep(Mask m, Vec a) { return select(m, a, zero()); }

// The sum of all lanes, in a fixed order.
PADGS_INLINE float sum(Vec v) {
  typedef float Quarter __attribute__((vector_size(16)));
  Quarter q[4];
  std::memcpy(q, &v, sizeof q);
  const Quarter s = (q[0] + q[2]) + (q[1] + q[3]);
  return (s[0] + s[2]) + (s[1] + s[3]);
}

// The sums of eight vectors at once.
typedef float Half __attribute__((vector_size(32)));
PADGS_INLINE void sum8(const Vec *v, float *out) {
  Half h[8];  // halves of each, added up
  for (int k = 0; k < 8; ++k) {
    Half both[2];
    std::memcpy(both, v + k, sizeof both);
    h[k] = both[0] + both[1];
  }
  Half quads[4];  // four lanes of v[k], and four of v[k + 4]
  for (int k = 0; k < 4; ++k)
    quads[k] = __builtin_shufflevector(h[k], h[k + 4], 0, 1, 2, 3, 12, 13, 14, 15) +
               __builtin_shufflevector(h[k], h[k + 4], 4, 5, 6, 7, 8, 9, 10, 11);
  Half pairs[2];
  for (int k = 0; k < 2; ++k)
    pairs[k] = __builtin_shufflevector(quads[2 * k], quads[2 * k + 1], 0, 8, 1, 9, 4, 12, 5, 13) +
               __builtin_shufflevector(quads[2 * k], quads[2 * k + 1], 2, 10, 3, 11, 6, 14, 7, 15);
  const Half total = __builtin_shufflevector(pairs[0], pairs[1], 0, 1, 8, 9, 4, 5, 12, 13) +
                     __builtin_shufflevector(pairs[0], pairs[1], 2, 3, 10, 11, 6, 7, 14, 15);
  std::memcpy(out, &total, sizeof total);
}

constexpr float kLog2E = 1.44269504088896341f;

// 2^r to 2.3e-7 relative for r in [-1/2, 1/2]: a minimax polynomial of degree 5.
PADGS_INLINE Vec exp2_fraction(Vec r) {
  Vec p = r * 0.0013276471f + 0.0096755419f;
  p = p * r + 0.0555071309f;
  p = p * r + 0.2402212024f;
  p = p * r + 0.6931469440f;
  return p * r + 1.0f;
}

// 2^x as accurately for x in [-100, 100].
PADGS_INLINE Vec exp2_fast(Vec x) {
  const Vec n = round_nearest(x);
  return scale_by_power(exp2_fraction(x - n), n);
}

}  // namespace PADGS_ISA
}  // namespace padgs
