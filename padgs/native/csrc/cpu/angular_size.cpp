// The mean angular size of Gaussians and its derivative by their scales. padgs.methods.plus.model is the definition.
#include <algorithm>
#include <vector>

#include "items.h"
#include "kernels.h"
#include "simd_math.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

constexpr int kAxes = 3;
constexpr int64_t kBlock = 1024;  // Gaussians of a partial sum; fixed, so that sums are too

// The sum over sixteen Gaussians; leaves the derivatives.
float sixteen(const AngularSizeArguments &args, int64_t first, float each) {
  Vec mean[kAxes], scale[kAxes], squared = zero(), sizes = zero();
  load_items<kAxes>(args.means, first, args.count, mean);
  load_items<kAxes>(args.scales, first, args.count, scale);
  for (int c = 0; c < kAxes; ++c) {
    const Vec away = mean[c] - args.center[c];
    squared += away * away;
    sizes += scale[c];
  }
  // NaN compares as not less, and must reach the loss; `maximum` drops it on some machines.
  const Vec distance = root(squared), nearest = splat(args.nearest);
  const Vec inverse = each / select(less(distance, nearest), nearest, distance);
  if (args.gradient) {
    const Vec gradient[kAxes] = {inverse, inverse, inverse};
    store_items<kAxes>(args.gradient, first, args.count, gradient);
  }
  return sum(select(less(iota(), splat(float(args.count - first))), sizes * inverse, zero()));
}

double angular_size(const AngularSizeArguments &args) {
  const float each = 1.0f / (kAxes * float(args.count));
  std::vector<double> blocks((args.count + kBlock - 1) / kBlock, 0.0);
#pragma omp parallel for schedule(static)
  for (int64_t block = 0; block < int64_t(blocks.size()); ++block)
    for (int64_t first = block * kBlock; first < std::min(args.count, (block + 1) * kBlock); first += kLanes)
      blocks[block] += sixteen(args, first, each);
  double total = 0;
  for (double block : blocks) total += block;
  return total;
}

}  // namespace

extern const AngularSizeKernels angular_size_kernels;
const AngularSizeKernels angular_size_kernels = {angular_size};

}  // namespace PADGS_ISA
}  // namespace padgs
