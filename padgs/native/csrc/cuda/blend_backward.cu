// Sorted blending, backward: a pixel undoes its blending from behind. And, for both ways of blending, the sum of a
// Gaussian's gradient sums over its instances.
#include "gradient_sums.cuh"

namespace padgs {
namespace {

constexpr int kGaussiansPerBlock = 16;

struct SortedPixel {
  Upstream up{};
  float transmittance = 1;  // in front of all that has been visited
  float behind = 0;         // sum of weight * (upstream of its colour and depth) behind it, background included
  int end = 0;

  __device__ SortedPixel(const BlendGradientInputs &args, const PixelPlace &place, int) {
    if (!place.inside) return;
    const int64_t p = place.index;
    transmittance = args.forward.transmittance[p];
    float grad_t = load_upstream(args, p, up);
    if (args.grad_depth && transmittance < 1) {  // depth = sum(w r) / (1 - T)
      up.depth = args.grad_depth[p] / (1.0f - transmittance);
      grad_t += up.depth * args.forward.depth[p];
    }
    behind = transmittance * grad_t;
    end = args.forward.last[p];
  }

  __device__ float step_back(const Footprint &f, int32_t, float log2_alpha, float &weight) {
    const float full = quick_exp2(log2_alpha), alpha = smaller(full, kAlphaMax);
    const float inverse = quick_inverse(1.0f - alpha);
    transmittance *= inverse;
    weight = alpha * transmittance;
    const float signal = weight * up.along(f);
    // alpha dL/dalpha = T alpha (c . G) - (contribution behind) alpha / (1 - alpha), and 0 where alpha is limited.
    const float m = full < kAlphaMax ? signal - behind * (inverse * alpha) : 0.0f;
    behind += signal;
    return m;
  }
};

// Sixteen threads add up the gradient sums of a Gaussian's instances, always in the same order: every eighth slot by itself,
// so that eight of a Gaussian of thousands of tiles are on their way at once.
__global__ void __launch_bounds__(kGaussiansPerBlock *kGradientSums) sum_kernel(BlendGradientInputs args) {
  const int64_t i = global_thread() / kGradientSums;
  const int k = int(threadIdx.x) % kGradientSums;
  if (i >= args.visible) return;
  float part[8] = {}, sum = 0;
  uint32_t slot = args.slot_start[i];
  const uint32_t end = args.slot_start[i + 1];
  for (; slot + 8 <= end; slot += 8)
    for (int j = 0; j < 8; ++j) part[j] += args.gradient_sums[slot + j].of[k];
  for (; slot < end; ++slot) sum += args.gradient_sums[slot].of[k];
  for (int j = 0; j < 8; ++j) sum += part[j];
  args.totals[int64_t(args.order[i]) * kGradientSums + k] += sum;
}

}  // namespace
}  // namespace padgs

using namespace padgs;

PADGS_API int padgs_cuda_blend_backward(const Queue *queue, const BlendGradientInputs *args) {
  return on_device(*queue, [&] {
    if (args->forward.core_size)
      hybrid_backward(*queue, *args);
    else
      launch_gradient_sums<SortedPixel, SortedPixel>(*queue, *args);
    launch(sum_kernel, blocks_for(args->visible, kGaussiansPerBlock), kGaussiansPerBlock * kGradientSums, *queue, *args);
    return 0;
  });
}
