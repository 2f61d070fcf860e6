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

  // Visits (half, output, pair of its and the next one's) of the lane's anchors.
  template <class T, class Visit>
  __device__ void outputs(const InputRows<T> &inputs, int units, Visit visit) const {
    FragmentA hidden[kMostHidden / 16];
    HiddenUnits<T>(inputs, first, units).as_factors(hidden);
    for (int tile = 0; tile < kOutputParts<kValues, 8>; ++tile) {
      const int output = 8 * tile + 2 * (lane_index() % 4);
      Sums sums{bias[output], bias[output + 1], bias[output], bias[output + 1]};
      multiply_add<T>(sums, hidden, second.at[tile]);
      for (int half = 0; half < 2; ++half) visit(half, output, packed(sums.of[2 * half], sums.of[2 * half + 1], T{}));
    }
  }
};

// Outputs of a warp's anchors, on their way from the lanes that summed them to those that place a Gaussian each.
template <int kValues>
struct Outputs {
  uint32_t pairs[kRows][kOutputParts<kValues, 8> * 4 | 4];  // so many that rows begin at different banks

  template <class T>
  __device__ void of_gaussian(int row, int k, float (&values)[kValues]) const {
    for (int c = 0; c < kValues; ++c) {
      const int output = kValues * k + c;
      const float2 pair = unpacked(pairs[row][output / 2], T{});
      values[c] = output % 2 ? pair.y : pair.x;
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
    unsigned selected = 0;  // how many of both anchors of the lane, in 16 bits each
    opacity.outputs(inputs, args.hidden, [&](int half, int output, uint32_t pair) {
      const float2 numbers = unpacked(pair, T{});
      for (int j = 0; j < 2 && output + j < args.offsets && anchors.of(half) >= 0; ++j) {
        const float raw = tanhf(j ? numbers.y : numbers.x);
        args.raw_opacities[anchors.of(half) * args.offsets + output + j] = raw;
        selected += unsigned(raw > 0) << 16 * half;
      }
    });
    for (int step = 1; step < 4; step *= 2) selected += __shfl_xor_sync(kAllLanes, selected, step);
    for (int half = 0; half < 2; ++half)
      if (anchors.of(half) >= 0 && lane_index() % 4 == 0)
        args.slot_start[anchors.of(half) + 1] = selected >> 16 * half & 0xffff;
  }
}

template <class T>
__global__ void __launch_bounds__(kThreads) attributes_kernel(NetworkArguments network) {
  const DecodeArguments &args = network.device.decode;
  __shared__ Network<kColorValues> color;
  __shared__ Network<kCovarianceValues> covariance;
  __shared__ Outputs<kColorValues> colors[kWarps];
  __shared__ Outputs<kCovarianceValues> covariances[kWarps];
  color.fill<T>(args.color, args);
  covariance.fill<T>(args.covariance, args);
  __syncthreads();
  const int64_t count = args.slot_start[args.anchors];
  auto &my_colors = colors[threadIdx.x / kWarp];
  auto &my_covariances = covariances[threadIdx.x / kWarp];
  const int group = lane_index() / 4;
  for (int64_t tile = blockIdx.x; tile * kWarps * kRows < args.anchors; tile += gridDim.x) {
    const Anchors anchors(tile, args.anchors);
    const InputRows<T> inputs(network.inputs, anchors, args.inputs);
    color.outputs(inputs, args.hidden, [&](int half, int output, uint32_t pair) {
      my_colors.pairs[8 * half + group][output / 2] = pair;
    });
    covariance.outputs(inputs, args.hidden, [&](int half, int output, uint32_t pair) {
      my_covariances.pairs[8 * half + group][output / 2] = pair;
    });
    __syncwarp();
    each_gaussian(args, anchors, [&](int row, int k, bool selected, int64_t before) {
      const int64_t anchor = anchors.first + row, slot = anchor * args.offsets + k;
      const Row to = row_of(slot, selected, before, count, network.device.room);
      if (!to.written) return;
      float of_color[kColorValues], of_covariance[kCovarianceValues];
      my_colors.template of_gaussian<T>(row, k, of_color);
      my_covariances.template of_gaussian<T>(row, k, of_covariance);
      place(args, anchor, slot, to, of_color, of_covariance);
    });
    __syncwarp();
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
