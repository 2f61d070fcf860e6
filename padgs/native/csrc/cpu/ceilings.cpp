// Peak rates of this machine, which padgs bench compares with: arithmetic without memory, and
// memory without arithmetic, on all threads. Both return the work they did; the caller reads the clocks.
#include "kernels.h"
#include "simd.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

// Enough independent chains to hide the latency of a fused multiply-add on two ports, few enough for 16 registers.
constexpr int kChains = 12;

// Floating-point operations of `rounds` steps of every chain, an FMA counting as two.
double fma(int64_t rounds) {
  int threads = 0;
  float sum = 0;
#pragma omp parallel reduction(+ : threads, sum)
  {
    Part chain[kChains];
    for (int c = 0; c < kChains; ++c) chain[c] = float(c) - Part{};
    const Part factor = 0.999f - Part{}, term = 0.001f - Part{};  // each chain goes to 1: never tiny, never huge
    for (int64_t i = 0; i < rounds; ++i)
      for (int c = 0; c < kChains; ++c) chain[c] = chain[c] * factor + term;
    for (int c = 0; c < kChains; ++c)
      for (size_t lane = 0; lane < sizeof(Part) / sizeof(float); ++lane) sum += chain[c][lane];
    threads = 1;
  }
  const double done = 2.0 * double(threads) * double(rounds) * kChains * double(sizeof(Part) / sizeof(float));
  return sum == -1 ? 0 : done;  // never -1, but the compiler cannot know, and so has to compute it
}

// Bytes of a = a + 3 b. In place, so that no line is fetched only to be overwritten: 12 bytes per element really move.
double triad(float *a, const float *b, int64_t count) {
#pragma omp parallel for simd schedule(static)
  for (int64_t i = 0; i < count; ++i) a[i] = a[i] + 3.0f * b[i];
  return 3.0 * sizeof(float) * double(count);
}

}  // namespace

extern const CeilingKernels ceiling_kernels;
const CeilingKernels ceiling_kernels = {fma, triad};

}  // namespace PADGS_ISA
}  // namespace padgs
