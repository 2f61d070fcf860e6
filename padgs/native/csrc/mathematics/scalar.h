// The elementary functions that the geometry is written in, for one float. simd_math.h has them for sixteen, so that
// one template serves a CPU lane, a CUDA thread and a test.
#pragma once

#include <cmath>
#include <cstdint>

#if defined(__CUDACC__)
#define PADGS_HD __host__ __device__ inline
#elif defined(__GNUC__)
#define PADGS_HD inline __attribute__((always_inline))  // else the linker would keep one instruction set's copy for all
#else
#define PADGS_HD inline
#endif

namespace padgs {

constexpr float kPi = 3.14159265358979323846f;

PADGS_HD float root(float x) { return sqrtf(x); }
PADGS_HD float reciprocal(float x) { return 1.0f / x; }
PADGS_HD float arctangent2(float y, float x) { return atan2f(y, x); }
PADGS_HD float logarithm2(float x) { return log2f(x); }
PADGS_HD float smaller(float a, float b) { return fminf(a, b); }
PADGS_HD float larger(float a, float b) { return fmaxf(a, b); }
PADGS_HD float magnitude(float a) { return fabsf(a); }
PADGS_HD float floored(float a) { return floorf(a); }
PADGS_HD float where(bool condition, float a, float b) { return condition ? a : b; }
PADGS_HD bool below(float a, float b) { return a < b; }
PADGS_HD float constant(float value, float) { return value; }  // the second argument says of which type

}  // namespace padgs
