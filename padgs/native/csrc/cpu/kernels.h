// The functions that exist once for each instruction set, and how the rest of the library reaches them.
#pragma once

#include "../abi.h"

namespace padgs {

struct ProjectKernels {
  void (*forward)(const Camera &, const Inputs &, Footprint *, PixelBox *);
  void (*backward)(const Camera &, const Inputs &, const float *gradient_sums, const Gradients &);
};

struct BlendKernels {
  void (*forward)(const BlendArguments &);
  void (*backward)(const BlendGradientArguments &);
};

struct HybridKernels : BlendKernels {
  int64_t (*core_words)(const BlendArguments &);  // the most that forward can leave to backward
};

struct LeaveOneOutKernels {
  void (*run)(const LeaveOneOutArguments &);  // sorted blending only
};

struct SplatKernels {
  void (*run)(const SplatArguments &);
};

struct LossKernels {
  double (*photometric)(const LossArguments &);
  int64_t (*workspace)(int32_t height, int32_t width);
};

struct RoughnessKernels {
  double (*run)(const RoughnessArguments &);
  int64_t (*workspace)(int32_t height, int32_t width);
};

struct DecodeKernels {
  void (*select)(const DecodeArguments &);  // raw opacities and slot_start; after it N is known
  void (*place)(const DecodeArguments &);   // everything else
  void (*backward)(const DecodeGradientArguments &);
};

struct CeilingKernels {
  double (*fma)(int64_t rounds);
  double (*triad)(float *a, const float *b, int64_t count);
};

}  // namespace padgs
