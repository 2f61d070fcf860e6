// Anchors to Gaussians (paper Eq. 13-15), around the matrix products of the networks in float32, which are cuBLAS's:
// select and place forward; from the gradients of the Gaussians to those of the networks' outputs, offsets and scales
// backward.
#include "decode.cuh"

namespace padgs {
namespace {

constexpr int kThreads = 128;

// A thread for each of the A K Gaussians.
__global__ void __launch_bounds__(kThreads) place_kernel(DeviceDecodeArguments device) {
  const DecodeArguments &args = device.decode;
  const int64_t slot = global_thread();
  const int k = args.offsets;
  if (slot >= args.anchors * k) return;
  const int64_t anchor = slot / k;
  int64_t before = args.slot_start[anchor];
  for (int64_t other = anchor * k; other < slot; ++other) before += args.raw_opacities[other] > 0;
  const int64_t count = args.slot_start[args.anchors];
  const Row row = row_of(slot, args.raw_opacities[slot] > 0, before, count, device.room);
  if (!row.written) return;
  float color[kColorValues], covariance[kCovarianceValues];
  for (int c = 0; c < kColorValues; ++c) color[c] = device.color_logits[kColorValues * slot + c];
  for (int c = 0; c < kCovarianceValues; ++c) covariance[c] = device.covariance_logits[kCovarianceValues * slot + c];
  place(args, anchor, slot, row, color, covariance);
}

// A thread for each anchor, which sums over its Gaussians in their order. The networks' outputs are left out where
// `kOutputs` is not set.
template <bool kOutputs>
__global__ void __launch_bounds__(kThreads) take_back_kernel(DeviceDecodeGradientArguments device) {
  const DecodeGradientArguments &args = device.gradient;
  const DecodeArguments &in = args.forward;
  const int64_t anchor = global_thread();
  const int k = in.offsets;
  if (anchor >= in.anchors) return;
  int64_t n = in.slot_start[anchor];
  float reach[3], grad_log[6] = {};
  for (int c = 0; c < 3; ++c) reach[c] = expf(in.log_scales[6 * anchor + c]);
  for (int64_t slot = anchor * k; slot < (anchor + 1) * k; ++slot) {
    const bool chosen = in.raw_opacities[slot] > 0, selected = chosen && n < device.room;
    for (int c = 0; c < 3; ++c) {
      const float grad_offset = selected ? args.means[3 * n + c] * reach[c] : 0.0f;
      args.offsets_out[3 * slot + c] = grad_offset;
      if (selected) {
        grad_log[c] += grad_offset * in.offset_rows[3 * slot + c];
        grad_log[3 + c] += args.scales[3 * n + c] * in.scales[3 * n + c];
      }
    }
    if constexpr (kOutputs) {
      float *color = device.color_out + kColorValues * slot;
      float *covariance = device.covariance_out + kCovarianceValues * slot;
      device.opacity_out[slot] = selected ? output_gradient<kOpacityValues>(args, anchor, slot, n, 0) : 0.0f;
      for (int c = 0; c < kColorValues; ++c)
        color[c] = selected ? output_gradient<kColorValues>(args, anchor, slot, n, c) : 0.0f;
      for (int c = 0; c < kCovarianceValues; ++c)
        covariance[c] = selected ? output_gradient<kCovarianceValues>(args, anchor, slot, n, c) : 0.0f;
    }
    n += chosen;
  }
  for (int c = 0; c < 6; ++c) args.log_scales_out[6 * anchor + c] = grad_log[c];
}

}  // namespace
}  // namespace padgs

using namespace padgs;

PADGS_API int padgs_cuda_decode_place(const Queue *queue, const DeviceDecodeArguments *args) {
  return on_device(*queue, [&] {
    launch(place_kernel, blocks_for(args->decode.anchors * args->decode.offsets, kThreads), kThreads, *queue, *args);
    return 0;
  });
}

// Outputs of the networks are left out where there is no room for them.
PADGS_API int padgs_cuda_decode_take_back(const Queue *queue, const DeviceDecodeGradientArguments *args) {
  return on_device(*queue, [&] {
    const auto kernel = args->opacity_out ? take_back_kernel<true> : take_back_kernel<false>;
    launch(kernel, blocks_for(args->gradient.forward.anchors, kThreads), kThreads, *queue, *args);
    return 0;
  });
}
