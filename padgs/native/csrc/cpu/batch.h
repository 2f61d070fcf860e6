// Some instances of a tile side by side, and for each patch which of them reach it: footprints lie scattered in memory,
// and a patch that is finished before the next stays in registers.
#pragma once

#include <algorithm>
#include <vector>

#include "tiles.h"

namespace padgs {
namespace PADGS_ISA {

constexpr int kBatch = 256;  // instances; the number of one fits into a byte

template <class Seen>
class Batch {
 public:
  // The instances of a tile from `start` on, as many as fit.
  void load(const BlendArguments &args, const Tile &tile, int64_t start) {
    size_ = int(std::min<int64_t>(kBatch, tile.end - start));
    lists_.resize(size_t(tile.patches()) * kBatch);
    counts_.assign(tile.patches(), 0);
    Seen *seen = seen_.data();
    uint8_t *lists = lists_.data();
    int *counts = counts_.data();
    for (int i = 0; i < size_; ++i) {
      prefetch(args, start + i + kAhead, tile.end);
      const Instance instance = args.instances[start + i];
      seen[i] = Seen(args.footprints[instance.gaussian], args, tile);
      for_each_patch(tile, instance, [&](int p) { lists[size_t(p) * kBatch + counts[p]++] = uint8_t(i); });
    }
  }
  int size() const { return size_; }
  const Seen *seen() const { return seen_.data(); }
  int count(int patch) const { return counts_[patch]; }                           // of those that reach a patch
  const uint8_t *list(int patch) const { return &lists_[size_t(patch) * kBatch]; }  // which

 private:
  std::vector<Seen> seen_ = std::vector<Seen>(kBatch);
  std::vector<uint8_t> lists_;  // [patches, kBatch]
  std::vector<int> counts_;     // [patches]
  int size_ = 0;
};

// This thread's, whose memory is used again.
template <class Seen>
Batch<Seen> &batch_of_thread() {
  static thread_local Batch<Seen> batch;
  return batch;
}

}  // namespace PADGS_ISA
}  // namespace padgs
