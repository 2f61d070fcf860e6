// Chooses the instruction set once, at the first call. PADGS_ISA=baseline|avx2|avx512 asks for at most that one.
#include <cstdlib>
#include <cstring>

#include "kernels.h"

namespace padgs {

#define PADGS_DECLARE(isa)                    \
  namespace isa {                             \
  extern const ProjectKernels project_kernels; \
  extern const BlendKernels blend_kernels;    \
  extern const HybridKernels hybrid_kernels;  \
  extern const LeaveOneOutKernels leave_one_out_kernels; \
  extern const SplatKernels splat_kernels;    \
  extern const LossKernels loss_kernels;      \
  extern const RoughnessKernels roughness_kernels; \
  extern const DecodeKernels decode_kernels;  \
  extern const CeilingKernels ceiling_kernels; \
  }
PADGS_DECLARE(baseline)
#if PADGS_ISA_COUNT > 1
PADGS_DECLARE(avx2)
PADGS_DECLARE(avx512)
#endif

struct Kernels {
  const char *name;
  const ProjectKernels &project;
  const BlendKernels &blend;
  const HybridKernels &hybrid;
  const LeaveOneOutKernels &leave_one_out;
  const SplatKernels &splats;
  const LossKernels &loss;
  const RoughnessKernels &roughness;
  const DecodeKernels &decode;
  const CeilingKernels &ceilings;
};

#define PADGS_KERNELS(isa)                                                                                      \
  {#isa,                       isa::project_kernels, isa::blend_kernels,        isa::hybrid_kernels,             \
   isa::leave_one_out_kernels, isa::splat_kernels,   isa::loss_kernels,         isa::roughness_kernels,          \
   isa::decode_kernels,        isa::ceiling_kernels}

static Kernels choose() {
#if PADGS_ISA_COUNT > 1
  const char *limit = std::getenv("PADGS_ISA");
  const auto allowed = [&](const char *isa) {
    return !limit || std::strcmp(limit, isa) == 0 || std::strcmp(limit, "avx512") == 0;
  };
  const bool has_avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  const bool has_avx512 = has_avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                          __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
  if (has_avx512 && allowed("avx512")) return PADGS_KERNELS(avx512);
  if (has_avx2 && allowed("avx2")) return PADGS_KERNELS(avx2);
#endif
  return PADGS_KERNELS(baseline);
}

static const Kernels &kernels() {
  static const Kernels chosen = choose();
  return chosen;
}

}  // namespace padgs

using namespace padgs;

// Bytes of the structures of abi.h that cross the border, in the order of STRUCTURES in padgs/native/cpu.py, which
// refuses to talk to a library that was built from other sources.
PADGS_API int64_t padgs_structure_bytes(int32_t index) {
  const size_t bytes[] = {sizeof(Camera), sizeof(Inputs), sizeof(Gradients), sizeof(BlendGradientArguments),
                          sizeof(DecodeGradientArguments), sizeof(LossArguments), sizeof(SplatArguments),
                          sizeof(LeaveOneOutArguments), sizeof(RoughnessArguments)};
  return index >= 0 && size_t(index) < sizeof(bytes) / sizeof(*bytes) ? int64_t(bytes[index]) : -1;
}

PADGS_API const char *padgs_isa() { return kernels().name; }

PADGS_API void padgs_project(const Camera *camera, const Inputs *in, Footprint *footprints, PixelBox *boxes) {
  kernels().project.forward(*camera, *in, footprints, boxes);
}

// Gradients of every input from the gradient sums [N, kGradientSums], already summed over the instances of each Gaussian.
PADGS_API void padgs_project_backward(const Camera *camera, const Inputs *in, const float *gradient_sums,
                                      const Gradients *out) {
  kernels().project.backward(*camera, *in, gradient_sums, *out);
}

static const BlendKernels &blending(int32_t core_size) {
  if (core_size) return kernels().hybrid;
  return kernels().blend;
}

PADGS_API void padgs_blend_forward(const BlendArguments *args) { blending(args->core_size).forward(*args); }

PADGS_API void padgs_blend_backward(const BlendGradientArguments *args) {
  blending(args->forward.core_size).backward(*args);
}

// For `cores` of the same arguments, where no outputs are needed yet.
PADGS_API int64_t padgs_core_words(const BlendArguments *args) { return kernels().hybrid.core_words(*args); }

// After padgs_blend_forward with the same arguments, sorted.
PADGS_API void padgs_leave_one_out(const LeaveOneOutArguments *args) { kernels().leave_one_out.run(*args); }

PADGS_API void padgs_splats(const SplatArguments *args) { kernels().splats.run(*args); }

PADGS_API double padgs_photometric_loss(const LossArguments *args) { return kernels().loss.photometric(*args); }

PADGS_API int64_t padgs_loss_workspace(int32_t height, int32_t width) {
  return kernels().loss.workspace(height, width);
}

PADGS_API double padgs_roughness(const RoughnessArguments *args) { return kernels().roughness.run(*args); }

PADGS_API int64_t padgs_roughness_workspace(int32_t height, int32_t width) {
  return kernels().roughness.workspace(height, width);
}

PADGS_API void padgs_decode_select(const DecodeArguments *args) { kernels().decode.select(*args); }

PADGS_API void padgs_decode_place(const DecodeArguments *args) { kernels().decode.place(*args); }

PADGS_API void padgs_decode_backward(const DecodeGradientArguments *args) { kernels().decode.backward(*args); }

// Floating-point operations done: `rounds` steps of fused multiply-adds on every thread.
PADGS_API double padgs_measure_fma(int64_t rounds) { return kernels().ceilings.fma(rounds); }

// Bytes moved by a = a + 3 b over arrays [count].
PADGS_API double padgs_measure_triad(float *a, const float *b, int64_t count) {
  return kernels().ceilings.triad(a, b, count);
}
