// Stable radix sort and prefix sum, by CUB.
#pragma once

#include "arguments.h"
#include "device.cuh"

namespace padgs {

int64_t sort_bytes(int64_t count);
int64_t scan_bytes(int64_t count);
int sort_pairs(const Queue &queue, const SortArguments &args);
int exclusive_sum(const Queue &queue, const SortArguments &scratch, const uint32_t *in, uint32_t *out, int64_t count);

}  // namespace padgs
