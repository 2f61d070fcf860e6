// Stable radix sort and prefix sum, by CUB. The sum stays at kMostInstances where it would exceed that.
#pragma once

#include "arguments.h"
#include "device.cuh"

namespace padgs {

constexpr uint32_t kMostInstances = 0x7fffffffu;

struct SaturatingSum {
  // Of two that are not more than kMostInstances themselves.
  PADGS_HD uint32_t operator()(uint32_t a, uint32_t b) const {
    return a + b < kMostInstances ? a + b : kMostInstances;
  }
};

int64_t sort_bytes(int64_t count);
int64_t scan_bytes(int64_t count);
int sort_pairs(const Queue &queue, const SortArguments &args);
int exclusive_sum(const Queue &queue, const SortArguments &scratch, const uint32_t *in, uint32_t *out, int64_t count);

}  // namespace padgs
