// Decoding with the networks' products on tensor cores, forward: opacities first, then, when it is known where the
// selected Gaussians go, colours and covariances into their places. Outputs of networks never reach memory.
#include "networks.cuh"

namespace padgs {
namespace {

template <int kValues>
struct Network {
  FirstLayer first;
  SecondLayer<kValues> second;
  float bias[8 * kOutputParts<kValues, 8>];

  // All threads of the block, before a barrier.
  template <class T>
  __device__ void fill(const HeadWeights &head, const DecodeArguments &args) {
    fill_first_layer<T>(first, head, args);
    padgs::fill<T>(second, [&](int unit, int output) {
      return unit < args.hidden && output < kValues * args.offsets ? head.w2[output * args.hidden + unit] : 0.0f;
    });
    for (int i = int(threadIdx.x); i < 8 * kOutputParts<kValues, 8>; i += kThreads)
      bias[i] = unpacked(packed(i < kValues * args.offsets ? head.b2[i] : 0.0f, 0, T{}), T{}).x;
  }

  // Visits (half, output, what it is) of the lane's anchors.
  template <class T, class Visit>
  __device__ void outputs(const InputRows<T> &inputs, const DecodeArguments &args, Visit visit) const {
    FragmentA hidden[kMostHidden / 16];
    HiddenUnits<T>(inputs, first, args.hidden).as_factors(hidden);
    for (int tile = 0; tile < kOutputParts<kValues, 8>; ++tile) {
      const int output = 8 * tile + 2 * (lane_index() % 4);
      Sums sums{bias[output], bias[output + 1], bias[output], bias[output + 1]};
      multiply_add<T>(sums, hidden, second.at[tile]);
      round_to<T>(sums);
      for (int i = 0; i < 4; ++i)
        if (output + i % 2 < kValues * args.offsets) visit(i / 2, output + i % 2, sums.of[i]);
    }
  }
};

// Opacities, and how many Gaussians of each anchor are selected, where the next one's first will be written.
template <class T>
__global__ void __launch_bounds__(kThreads) opacity_kernel(NetworkArguments network) {
  const DecodeArguments &args = network.device.decode;
  __shared__ Network<kOpacityValues> opacity;
  opacity.fill<T>(args.opacity, args);
  __syncthreads();
  for (int64_t tile = blockIdx.x; tile * kWarps * kRows < args.anchors; tile += gridDim.x) {
    const Anchors anchors(tile, args.anchors);
    const InputRows<T> inputs(network.inputs, anchors, args.inputs);
    int selected[2] = {};
    opacity.outputs(inputs, args, [&](int half, int k, float output) {
      const float raw = tanhf(output);
      selected[half] += raw > 0;
      if (anchors.there(half)) args.raw_opacities[anchors.of(half) * args.offsets + k] = raw;
    });
    for (int half = 0; half < 2; ++half) {
      for (int step = 1; step < 4; step *= 2) selected[half] += __shfl_xor_sync(kAllLanes, selected[half], step);
      if (anchors.there(half) && lane_index() % 4 == 0) args.slot_start[anchors.of(half) + 1] = selected[half];
    }
  }
}

template <class T>
__global__ void __launch_bounds__(kThreads) attributes_kernel(NetworkArguments network) {
  const DecodeArguments &args = network.device.decode;
  __shared__ Network<kColorValues> color;
  __shared__ Network<kCovarianceValues> covariance;
  color.fill<T>(args.color, args);
  covariance.fill<T>(args.covariance, args);
  __syncthreads();
  const int64_t count = args.slot_start[args.anchors];
  for (int64_t tile = blockIdx.x; tile * kWarps * kRows < args.anchors; tile += gridDim.x) {
    const Anchors anchors(tile, args.anchors);
    const InputRows<T> inputs(network.inputs, anchors, args.inputs);
    const Selection selections[] = {{args, anchors, 0}, {args, anchors, 1}};
    const auto row = [&](int half, int k) {
      const Selection &s = selections[half];
      return row_of(anchors.of(half) * args.offsets + k, s.has(k), s.before(k), count, network.device.room);
    };
    for (int half = 0; half < 2; ++half)
      for (int k = lane_index() % 4; anchors.there(half) && k < args.offsets; k += 4)
        place_gaussian(args, anchors.of(half), anchors.of(half) * args.offsets + k, row(half, k));
    color.outputs(inputs, args, [&](int half, int i, float output) {
      if (!anchors.there(half)) return;
      place_output<kColorValues>(args, anchors.of(half), row(half, i / kColorValues), i % kColorValues, output);
    });
    covariance.outputs(inputs, args, [&](int half, int i, float output) {
      if (!anchors.there(half)) return;
      const Row place = row(half, i / kCovarianceValues);
      place_output<kCovarianceValues>(args, anchors.of(half), place, i % kCovarianceValues, output);
    });
  }
}

template <class Kernel>
int launched(const Queue &queue, const NetworkArguments &network, Kernel of_bfloat16, Kernel of_float16) {
  return on_device(queue, [&] {
    const int64_t blocks = blocks_of_anchors(network.device.decode.anchors);
    launch(network.inputs.type == kFloat16 ? of_float16 : of_bfloat16, blocks, kThreads, queue, network);
    return 0;
  });
}

}  // namespace
}  // namespace padgs

using namespace padgs;

// Whether networks of this size have room, and the code that this device runs was compiled for tensor cores that can do it.
PADGS_API int padgs_cuda_networks_fit(const Queue *queue, int32_t features, int32_t inputs, int32_t hidden,
                                      int32_t offsets) {
  if (features > kMostFeatures || inputs >= kMostInputs || hidden > kMostHidden || offsets > kMostOffsets) return false;
#if defined(PADGS_EMULATED)
  return queue != nullptr;
#else
  cudaFuncAttributes code{};
  const int error = on_device(*queue, [&] { return int(cudaFuncGetAttributes(&code, opacity_kernel<Bfloat16>)); });
  return !error && code.ptxVersion >= 80;
#endif
}

// Fills raw_opacities and, behind the first, slot_start with how many Gaussians of each anchor are selected.
PADGS_API int padgs_cuda_networks_opacity(const Queue *queue, const NetworkArguments *args) {
  return launched(*queue, *args, opacity_kernel<Bfloat16>, opacity_kernel<Float16>);
}

// Fills the Gaussians; slot_start is the sums by now.
PADGS_API int padgs_cuda_networks_attributes(const Queue *queue, const NetworkArguments *args) {
  return launched(*queue, *args, attributes_kernel<Bfloat16>, attributes_kernel<Float16>);
}
