// Stable radix sort and prefix sum, by CUB; on the host, where only tests run, by the standard library.
#include "sort.cuh"

#if defined(PADGS_EMULATED)

#include <algorithm>
#include <numeric>
#include <vector>

namespace padgs {

int64_t sort_bytes(int64_t) { return 1; }
int64_t scan_bytes(int64_t) { return 1; }

int sort_pairs(const Queue &, const SortArguments &args) {
  const uint32_t mask = args.bits < 32 ? (1u << args.bits) - 1 : ~0u;
  std::vector<int64_t> order(size_t(args.count), 0);
  std::iota(order.begin(), order.end(), int64_t(0));
  std::stable_sort(order.begin(), order.end(),
                   [&](int64_t a, int64_t b) { return (args.keys[a] & mask) < (args.keys[b] & mask); });
  for (int64_t i = 0; i < args.count; ++i) {
    args.sorted_keys[i] = args.keys[order[i]];
    args.sorted_values[i] = args.values[order[i]];
  }
  return 0;
}

int exclusive_sum(const Queue &, const SortArguments &, const uint32_t *in, uint32_t *out, int64_t count) {
  uint32_t total = 0;
  for (int64_t i = 0; i < count; ++i) {
    out[i] = total;
    total = SaturatingSum()(total, in[i]);
  }
  return 0;
}

}  // namespace padgs

#else

#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>

namespace padgs {

int64_t sort_bytes(int64_t count) {
  size_t bytes = 0;
  const uint32_t *keys = nullptr;
  const int32_t *values = nullptr;
  const int error = int(cub::DeviceRadixSort::SortPairs(nullptr, bytes, keys, (uint32_t *)nullptr, values,
                                                        (int32_t *)nullptr, int32_t(count)));
  return error ? -error : int64_t(bytes);
}

int64_t scan_bytes(int64_t count) {
  size_t bytes = 0;
  const uint32_t *in = nullptr;
  const int error = int(
      cub::DeviceScan::ExclusiveScan(nullptr, bytes, in, (uint32_t *)nullptr, SaturatingSum(), 0u, int32_t(count)));
  return error ? -error : int64_t(bytes);
}

int sort_pairs(const Queue &queue, const SortArguments &args) {
  size_t bytes = size_t(args.scratch_bytes);
  const uint32_t *keys = args.keys;
  const int32_t *values = args.values;
  return int(cub::DeviceRadixSort::SortPairs(args.scratch, bytes, keys, args.sorted_keys, values, args.sorted_values,
                                             int32_t(args.count), 0, args.bits, cudaStream_t(queue.stream)));
}

int exclusive_sum(const Queue &queue, const SortArguments &scratch, const uint32_t *in, uint32_t *out, int64_t count) {
  size_t bytes = size_t(scratch.scratch_bytes);
  return int(cub::DeviceScan::ExclusiveScan(scratch.scratch, bytes, in, out, SaturatingSum(), 0u, int32_t(count),
                                            cudaStream_t(queue.stream)));
}

}  // namespace padgs

#endif

using namespace padgs;

// Bytes of scratch for sorting, or summing over, a number of items; or the negative of an error.
PADGS_API int64_t padgs_cuda_scratch_bytes(const Queue *queue, int64_t count) {
  int64_t sort = 0, scan = 0;
  const int error = on_device(*queue, [&] {
    sort = sort_bytes(count), scan = scan_bytes(count);
    return int(sort < 0 ? -sort : scan < 0 ? -scan : 0);
  });
  return error ? -error : sort > scan ? sort : scan;
}

PADGS_API int padgs_cuda_sort(const Queue *queue, const SortArguments *args) {
  return on_device(*queue, [&] { return args->count ? sort_pairs(*queue, *args) : 0; });
}
