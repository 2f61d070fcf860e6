// Chooses the instruction set once, at the first call. PADGS_ISA=baseline|avx2|avx512 forces one, for tests.
#include <cstdlib>
#include <cstring>

#include "kernels.h"

namespace padgs {
namespace baseline { extern const Kernels table; }
#if PADGS_ISA_COUNT > 1
namespace avx2 { extern const Kernels table; }
namespace avx512 { extern const Kernels table; }
#endif

static const Kernels &choose() {
#if PADGS_ISA_COUNT > 1
  const bool has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  const bool has_avx512 = has_avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                          __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
  const char *forced = std::getenv("PADGS_ISA");
  const bool any = forced == nullptr;
  if (has_avx512 && (any || std::strcmp(forced, "avx512") == 0)) return avx512::table;
  if (has_avx2 && (any || std::strcmp(forced, "avx512") == 0 || std::strcmp(forced, "avx2") == 0)) return avx2::table;
#endif
  return baseline::table;
}

const Kernels &kernels() {
  static const Kernels &chosen = choose();
  return chosen;
}

}  // namespace padgs

PADGS_API const char *padgs_isa() { return padgs::kernels().name; }

PADGS_API void padgs_blend_forward(const padgs::BlendArguments *args) { padgs::kernels().blend_forward(*args); }

PADGS_API void padgs_blend_backward(const padgs::BlendGradientArguments *args) {
  padgs::kernels().blend_backward(*args);
}
