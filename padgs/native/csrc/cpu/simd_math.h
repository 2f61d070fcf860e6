// scalar.h for sixteen floats at a time.
#pragma once

#include "../mathematics/scalar.h"
#include "simd.h"

namespace padgs {
namespace PADGS_ISA {

PADGS_INLINE Vec root(Vec x) {
#if defined(__AVX512F__)
  return vec(_mm512_sqrt_ps(raw(x)));
#else
  float lanes[kLanes];
  store(lanes, x);
  for (int i = 0; i < kLanes; ++i) lanes[i] = sqrtf(lanes[i]);
  return load(lanes);
#endif
}
PADGS_INLINE Vec smaller(Vec a, Vec b) { return minimum(a, b); }
PADGS_INLINE Vec larger(Vec a, Vec b) { return maximum(a, b); }
PADGS_INLINE Vec magnitude(Vec a) { return maximum(a, -a); }
PADGS_INLINE Vec floored(Vec a) { return round_down(a); }
PADGS_INLINE Vec where(Mask condition, Vec a, Vec b) { return select(condition, a, b); }
PADGS_INLINE Mask below(Vec a, Vec b) { return less(a, b); }
PADGS_INLINE Vec constant(float value, Vec) { return splat(value); }

// Angle of (x, y) to 3e-7: arctangent of the smaller over the larger side by a polynomial in its square, then octants.
PADGS_INLINE Vec arctangent2(Vec y, Vec x) {
  const Vec ax = magnitude(x), ay = magnitude(y);
  const Vec longer = maximum(ax, ay), shorter = minimum(ax, ay);
  const Vec t = shorter / select(less(zero(), longer), longer, splat(1.0f)), s = t * t;
  Vec p = s * 0.002920690f + -0.016367919f;
  p = p * s + 0.043211847f;
  p = p * s + -0.075522132f;
  p = p * s + 0.106660042f;
  p = p * s + -0.142110552f;
  p = p * s + 0.199937728f;
  p = p * s + -0.333331527f;
  Vec angle = p * s * t + t;
  angle = select(less(ax, ay), kPi / 2 - angle, angle);
  angle = select(less(x, zero()), kPi - angle, angle);
  return select(less(y, zero()), -angle, angle);
}

// log2 to 2e-7 absolute for normal positive numbers: the exponent, and a series in (m - 1) / (m + 1) of the mantissa.
PADGS_INLINE Vec logarithm2(Vec x) {
  Vec mantissa, exponent;
  PADGS_EACH_PART {
    const PartI bits = (PartI)x.p[i];
    const PartI shift = (bits - 0x3f3504f3) >> 23;  // so that the mantissa lies in [sqrt(1/2), sqrt(2))
    exponent.p[i] = __builtin_convertvector(shift, Part);
    mantissa.p[i] = (Part)(bits - (shift << 23));
  }
  const Vec z = (mantissa - 1.0f) / (mantissa + 1.0f), s = z * z;
  Vec p = s * (2.885390082f / 9) + 2.885390082f / 7;
  p = p * s + 2.885390082f / 5;
  p = p * s + 2.885390082f / 3;
  p = p * s + 2.885390082f;
  return exponent + z * p;
}

// e^x to 3e-7 relative: 2^n e^r of the nearest n. Other exponents use the C library.
PADGS_INLINE Vec exponential(Vec x) {
  constexpr float kMost = 69.0f, kLog2High = 0.693359375f, kLog2Low = -2.12194440e-4f;  // n * kLog2High is exact
  if (bits(less(magnitude(x), splat(kMost))) != (1u << kLanes) - 1) {  // NaN is not less either
    float lanes[kLanes];
    store(lanes, x);
    for (int i = 0; i < kLanes; ++i) lanes[i] = expf(lanes[i]);
    return load(lanes);
  }
  const Vec n = round_nearest(x * kLog2E), r = (x - n * kLog2High) - n * kLog2Low;
  return scale_by_power(exp2_fraction(r * kLog2E), n);
}

}  // namespace PADGS_ISA
}  // namespace padgs
