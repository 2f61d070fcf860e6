// Anchors to Gaussians (paper Eq. 13-15), around the matrix products of the networks in float32, which are cuBLAS's:
// select and place forward; from the gradients of the Gaussians to those of the networks' outputs, offsets and scales
// backward.
#include "decode.cuh"

namespace padgs {
namespace {

constexpr int kThreads = 128;

// How many Gaussians are selected before a slot.
__device__ int64_t selected_before(const DecodeArguments &args, int64_t anchor, int64_t slot) {
  int64_t before = args.slot_start[anchor];
  for (int64_t other = anchor * args.offsets; other < slot; ++other) before += args.raw_opacities[other] > 0;
  return before;
}

// A thread for each of the A K Gaussians.
__global__ void __launch_bounds__(kThreads) place_kernel(DeviceDecodeArguments device) {
  const DecodeArguments &args = device.decode;
  const int64_t slot = global_thread();
  const int k = args.offsets;
  if (slot >= args.anchors * k) return;
  const int64_t anchor = slot / k, before = selected_before(args, anchor, slot);
  const int64_t count = args.slot_start[args.anchors];
  const Row row = row_of(slot, args.raw_opacities[slot] > 0, before, count, device.room);
  if (!row.written) return;
  float color[kColorValues], covariance[kCovarianceValues];
  for (int c = 0; c < kColorValues; ++c) color[c] = device.color_logits[kColorValues * slot + c];
  for (int c = 0; c < kCovarianceValues; ++c) covariance[c] = device.covariance_logits[kCovarianceValues * slot + c];
  place(args, anchor, slot, row, color, covariance);
}

// A thread for each of the A K Gaussians: dL by its offset and by the networks' outputs.
__global__ void __launch_bounds__(kThreads) outputs_back_kernel(DeviceDecodeGradientArguments device) {
  const DecodeGradientArguments &args = device.gradient;
  const DecodeArguments &in = args.forward;
  const int64_t slot = global_thread();
  if (slot >= in.anchors * in.offsets) return;
  const int64_t anchor = slot / in.offsets, n = selected_before(in, anchor, slot);
  const bool selected = in.raw_opacities[slot] > 0 && n < device.room;
  float *color = device.color_out + kColorValues * slot, *covariance = device.covariance_out + kCovarianceValues * slot;
  for (int c = 0; c < 3; ++c)
    args.offsets_out[3 * slot + c] = selected ? args.means[3 * n + c] * expf(in.log_scales[6 * anchor + c]) : 0.0f;
  device.opacity_out[slot] = selected ? output_gradient<kOpacityValues>(args, anchor, slot, n, 0) : 0.0f;
  for (int c = 0; c < kColorValues; ++c)
    color[c] = selected ? output_gradient<kColorValues>(args, anchor, slot, n, c) : 0.0f;
  for (int c = 0; c < kCovarianceValues; ++c)
    covariance[c] = selected ? output_gradient<kCovarianceValues>(args, anchor, slot, n, c) : 0.0f;
}

// A thread for each anchor and axis, which sums over the anchor's Gaussians in their order; after outputs_back_kernel.
__global__ void __launch_bounds__(kThreads) scales_back_kernel(DeviceDecodeGradientArguments device) {
  const DecodeGradientArguments &args = device.gradient;
  const DecodeArguments &in = args.forward;
  const int64_t anchor = global_thread() / 3, c = global_thread() % 3;
  if (anchor >= in.anchors) return;
  int64_t n = in.slot_start[anchor];
  float of_reach = 0, of_size = 0;
  for (int64_t slot = anchor * in.offsets; slot < (anchor + 1) * in.offsets && n < device.room; ++slot) {
    if (!(in.raw_opacities[slot] > 0)) continue;  // NaN is not selected
    of_reach += args.offsets_out[3 * slot + c] * in.offset_rows[3 * slot + c];
    of_size += args.scales[3 * n + c] * in.scales[3 * n + c];
    ++n;
  }
  args.log_scales_out[6 * anchor + c] = of_reach;
  args.log_scales_out[6 * anchor + 3 + c] = of_size;
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
    const DecodeArguments &decode = args->gradient.forward;
    launch(outputs_back_kernel, blocks_for(decode.anchors * decode.offsets, kThreads), kThreads, *queue, *args);
    launch(scales_back_kernel, blocks_for(3 * decode.anchors, kThreads), kThreads, *queue, *args);
    return 0;
  });
}
