// The functions that exist once for each instruction set, and how the rest of the library reaches them.
#pragma once

#include "abi.h"

namespace padgs {

struct Kernels {
  const char *name;
  void (*blend_forward)(const BlendArguments &);
  void (*blend_backward)(const BlendGradientArguments &);
};

const Kernels &kernels();  // the best set that this processor can run; see dispatch.cpp

}  // namespace padgs
