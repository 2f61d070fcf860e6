// Anchors to Gaussians (paper Eq. 13-15), around the matrix products of the networks, which cuBLAS does better:
// select and place forward; from the gradients of the Gaussians to those of the networks' outputs, offsets and scales
// backward.
#include "arguments.h"
#include "device.cuh"

namespace padgs {
namespace {

constexpr int kThreads = 128;

__device__ float sigmoid(float x) { return 1.0f / (1.0f + expf(-x)); }

// A thread for each of the A K Gaussians.
__global__ void __launch_bounds__(kThreads) place_kernel(DeviceDecodeArguments device) {
  const DecodeArguments &args = device.decode;
  const int64_t slot = global_thread();
  const int k = args.offsets;
  if (slot >= args.anchors * k) return;
  const int64_t anchor = slot / k;
  const float raw = args.raw_opacities[slot];
  if (!(raw > 0)) return;
  int64_t n = args.slot_start[anchor];
  for (int64_t before = anchor * k; before < slot; ++before) n += args.raw_opacities[before] > 0;
  const float *color = device.color_logits + 3 * slot, *covariance = device.covariance_logits + 7 * slot;
  const float *logs = args.log_scales + 6 * anchor;
  args.slots[n] = slot;
  args.opacities[n] = raw * args.attenuation[anchor];
  for (int c = 0; c < 3; ++c) {
    args.means[3 * n + c] = args.positions[3 * anchor + c] + expf(logs[c]) * args.offset_rows[3 * slot + c];
    args.scales[3 * n + c] = expf(logs[3 + c]) * sigmoid(covariance[c]);
    args.colors[3 * n + c] = sigmoid(color[c]);
  }
  for (int c = 0; c < 4; ++c) args.quats[4 * n + c] = covariance[3 + c];
}

// A thread for each anchor, which sums over its Gaussians in their order.
__global__ void __launch_bounds__(kThreads) take_back_kernel(DeviceDecodeGradientArguments device) {
  const DecodeGradientArguments &args = device.gradient;
  const DecodeArguments &in = args.forward;
  const int64_t anchor = global_thread();
  const int k = in.offsets;
  if (anchor >= in.anchors) return;
  int64_t n = in.slot_start[anchor];
  float reach[6], grad_log[6] = {};
  for (int c = 0; c < 6; ++c) reach[c] = expf(in.log_scales[6 * anchor + c]);
  for (int64_t slot = anchor * k; slot < (anchor + 1) * k; ++slot) {
    const float raw = in.raw_opacities[slot];
    const bool selected = raw > 0;
    float *color_out = device.color_out + 3 * slot, *covariance_out = device.covariance_out + 7 * slot;
    device.opacity_out[slot] = selected ? args.opacities[n] * in.attenuation[anchor] * (1 - raw * raw) : 0.0f;
    for (int c = 0; c < 3; ++c) {
      float grad_color = 0, grad_shrinkage = 0, grad_offset = 0;
      if (selected) {
        const float color = in.colors[3 * n + c], scale = in.scales[3 * n + c];
        const float grad_mean = args.means[3 * n + c], grad_scale = args.scales[3 * n + c];
        grad_color = args.colors[3 * n + c] * color * (1 - color);
        grad_shrinkage = grad_scale * scale * (1 - scale / reach[3 + c]);  // scale = reach * s with s a sigmoid
        grad_offset = grad_mean * reach[c];
        grad_log[c] += grad_offset * in.offset_rows[3 * slot + c];
        grad_log[3 + c] += grad_scale * scale;
      }
      color_out[c] = grad_color;
      covariance_out[c] = grad_shrinkage;
      args.offsets_out[3 * slot + c] = grad_offset;
    }
    for (int c = 0; c < 4; ++c) covariance_out[3 + c] = selected ? args.quats[4 * n + c] : 0.0f;
    n += selected;
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

PADGS_API int padgs_cuda_decode_take_back(const Queue *queue, const DeviceDecodeGradientArguments *args) {
  return on_device(*queue, [&] {
    launch(take_back_kernel, blocks_for(args->gradient.forward.anchors, kThreads), kThreads, *queue, *args);
    return 0;
  });
}
