// Back through the decoder's networks on tensor cores: from the gradients of the Gaussians to those of features and
// weights. Hidden units are computed once more. Factors are bfloat16 whatever the type forward, sums are float32.
//
// A block takes 64 anchors at a time, in order. What goes into the gradients of weights, its warps leave for one another in
// shared memory, transposed, for there the anchors are what is summed over; each warp then adds up its own part of them.
#include "networks.cuh"

namespace padgs {
namespace {

constexpr int kSide = 16;  // of the parts that matrices come in
constexpr int kInputParts = kMostInputs / kSide, kHiddenParts = kMostHidden / kSide;

template <int kValues>
struct Network {
  FirstLayer first;
  Factor<kOutputParts<kValues, kSide>, kHiddenTiles> from_outputs;  // w2
  Factor<kHiddenParts, kMostFeatures / 8> from_hidden;              // w1

  // All threads of the block, before a barrier.
  template <class T>
  __device__ void fill(const HeadWeights &head, const DecodeArguments &in, int features) {
    fill_first_layer<T>(first, head, in);
    padgs::fill<Bfloat16>(from_outputs, [&](int output, int unit) {
      return unit < in.hidden && output < kValues * in.offsets ? head.w2[output * in.hidden + unit] : 0.0f;
    });
    padgs::fill<Bfloat16>(from_hidden, [&](int unit, int feature) {
      return unit < in.hidden && feature < features ? head.w1[unit * in.inputs + feature] : 0.0f;
    });
  }
};

// Output of a warp: columns of its sixteen anchors, transposed.
struct Left {
  FragmentA inputs[kInputParts][kWarp], hidden[kHiddenParts][kWarp], of_hidden[kHiddenParts][kWarp];
  FragmentA of_outputs[kOutputParts<kCovarianceValues, kSide>][kWarp];
};

// A warp's part of the gradients of one network's weights: by 16 inputs (with the 1 for the bias), or by 16 outputs.
template <int kValues>
struct WeightSums {
  static constexpr int kParts = kInputParts + kOutputParts<kValues, kSide>, kEach = (kParts + kWarps - 1) / kWarps;
  Sums of[kEach][kHiddenParts][2] = {};
  float bias[kEach][2] = {};  // of outputs

  static __device__ int part(int n) { return int(threadIdx.x) / kWarp + kWarps * n; }

  __device__ void add(const Left (&left)[kWarps]) {
    const int lane = lane_index();
    for (int n = 0; n < kEach; ++n) {
      if (part(n) >= kParts) continue;
      const bool input = part(n) < kInputParts;
      for (const Left &from : left) {
        const FragmentA &columns = input ? from.inputs[part(n)][lane] : from.of_outputs[part(n) - kInputParts][lane];
        for (int c = 0; c < 2; ++c) {
          const FragmentB column = columns_of(columns, c);
          for (int h = 0; h < kHiddenParts; ++h)
            multiply_add(of[n][h][c], (input ? from.of_hidden : from.hidden)[h][lane], column, Bfloat16{});
          for (const uint32_t pair : column.pairs) {
            const float2 numbers = unpacked(pair, Bfloat16{});
            bias[n][c] += numbers.x + numbers.y;
          }
        }
      }
    }
  }

  // w1, b1, w2, b2; returns the address behind them.
  __device__ float *write(float *w1, const DecodeArguments &in) const {
    const int outputs = kValues * in.offsets, group = lane_index() / 4, thread = lane_index() % 4;
    float *b1 = w1 + in.hidden * in.inputs, *w2 = b1 + in.hidden, *b2 = w2 + outputs * in.hidden;
#pragma unroll
    for (int n = 0; n < kEach; ++n) {
      if (part(n) >= kParts) continue;
      const bool input = part(n) < kInputParts;
      for (int c = 0; c < 2; ++c) {
        const int first = kSide * (input ? part(n) : part(n) - kInputParts) + 8 * c;
        for (int h = 0; h < kHiddenParts; ++h) {
          for (int i = 0; i < 4; ++i) {
            const int unit = kSide * h + group + i / 2 * 8, column = first + 2 * thread + i % 2;
            if (unit >= in.hidden || column >= (input ? in.inputs + 1 : outputs)) continue;
            float &to = !input ? w2[column * in.hidden + unit] :
                        column < in.inputs ? w1[unit * in.inputs + column] : b1[unit];
            to = of[n][h][c].of[i];
          }
        }
        float total = bias[n][c];
        for (int step = 1; step < 4; step *= 2) total += __shfl_xor_sync(kAllLanes, total, step);
        if (!input && thread == 0 && first + group < outputs) b2[first + group] = total;
      }
    }
    return b2 + outputs;
  }
};

using Number __attribute__((may_alias)) = uint16_t;

// Leaves dL by the outputs of a network.
template <int kValues>
__device__ void leave_output_gradients(const NetworkGradientArguments &network, const Anchors &anchors, Left &mine) {
  const DecodeGradientArguments &args = network.gradient;
  for (int step = 0; step < kOutputParts<kValues, kSide>; ++step) mine.of_outputs[step][lane_index()] = {};
  __syncwarp();
  each_gaussian(args.forward, anchors, [&](int row, int k, bool selected, int64_t n) {
    if (!selected || n >= network.room) return;
    const int64_t anchor = anchors.first + row, slot = anchor * args.forward.offsets + k;
    for (int c = 0; c < kValues; ++c) {
      const int output = kValues * k + c, lane = output % 8 * 4 + row % 8 / 2;
      uint32_t &pair = mine.of_outputs[output / kSide][lane].pairs[output % kSide / 8 + row / 8 * 2];
      const float gradient = output_gradient<kValues>(args, anchor, slot, n, c);
      reinterpret_cast<Number *>(&pair)[row % 2] = Number(packed(gradient, 0, Bfloat16{}));
    }
  });
  __syncwarp();
}

// Adds the gradients of one network to those of the features and of its weights.
template <class T, int kValues>
__device__ void go_back(const NetworkGradientArguments &network, const Network<kValues> &weights, const Anchors &anchors,
                        const InputRows<T> &inputs, Sums (&of_features)[kMostFeatures / 8], WeightSums<kValues> &of_weights, Left (&left)[kWarps]) {
  const DecodeGradientArguments &args = network.gradient;
  const int lane = lane_index();
  Left &mine = left[threadIdx.x / kWarp];
  leave_output_gradients<kValues>(network, anchors, mine);
  const HiddenUnits<T> hidden(inputs, weights.first, args.forward.hidden);
  Sums of_hidden[kHiddenTiles] = {};
  for (int step = 0; step < kOutputParts<kValues, kSide>; ++step) {
    const FragmentA of_outputs = transposed(mine.of_outputs[step][lane]);
    for (int tile = 0; tile < kHiddenTiles; ++tile)
      multiply_add(of_hidden[tile], of_outputs, weights.from_outputs.at[tile][step][lane], Bfloat16{});
  }
  for (int i = 0; i < 4 * kHiddenTiles; ++i)
    if (hidden.tiles[i / 4].of[i % 4] <= 0) of_hidden[i / 4].of[i % 4] = 0;
  FragmentA rows[kHiddenParts];
  for (int step = 0; step < kHiddenParts; ++step) {
    rows[step] = as_factor<Bfloat16>(of_hidden[2 * step], of_hidden[2 * step + 1]);
    mine.of_hidden[step][lane] = transposed(rows[step]);
    mine.hidden[step][lane] = transposed(as_factor<Bfloat16>(hidden.tiles[2 * step], hidden.tiles[2 * step + 1]));
  }
  for (int tile = 0; tile < kMostFeatures / 8; ++tile)
    multiply_add<Bfloat16>(of_features[tile], rows, weights.from_hidden.at[tile]);
  __syncthreads();
  of_weights.add(left);
  __syncthreads();
}

template <class T>
__global__ void __launch_bounds__(kThreads) backward_kernel(NetworkGradientArguments network) {
  const DecodeGradientArguments &args = network.gradient;
  const DecodeArguments &in = args.forward;
  const int features = network.inputs.feature_count, lane = lane_index();
  __shared__ Network<kOpacityValues> opacity;
  __shared__ Network<kColorValues> color;
  __shared__ Network<kCovarianceValues> covariance;
  __shared__ Left left[kWarps];
  opacity.fill<T>(in.opacity, in, features);
  color.fill<T>(in.color, in, features);
  covariance.fill<T>(in.covariance, in, features);
  __syncthreads();
  WeightSums<kOpacityValues> of_opacity;
  WeightSums<kColorValues> of_color;
  WeightSums<kCovarianceValues> of_covariance;
  for (int64_t tile = blockIdx.x; tile * kWarps * kRows < in.anchors; tile += gridDim.x) {
    const Anchors anchors(tile, in.anchors);
    const InputRows<T> inputs(network.inputs, anchors, in.inputs);
    const InputRows<Bfloat16> rounded(network.inputs, anchors, in.inputs);
    for (int step = 0; step < kInputParts; ++step)
      left[threadIdx.x / kWarp].inputs[step][lane] = transposed(rounded.steps[step]);
    Sums of_features[kMostFeatures / 8] = {};
    go_back(network, opacity, anchors, inputs, of_features, of_opacity, left);
    go_back(network, color, anchors, inputs, of_features, of_color, left);
    go_back(network, covariance, anchors, inputs, of_features, of_covariance, left);
    for (int step = 0; step < kMostFeatures / 8; ++step) {
      for (int i = 0; i < 4; ++i) {
        const int feature = 8 * step + 2 * (lane % 4) + i % 2;
        if (anchors.of(i / 2) >= 0 && feature < features)
          args.features_out[anchors.of(i / 2) * features + feature] = of_features[step].of[i];
      }
    }
  }
  const int outputs = (kOpacityValues + kColorValues + kCovarianceValues) * in.offsets;
  const int weights = 3 * in.hidden * (in.inputs + 1) + outputs * (in.hidden + 1);
  float *out = of_opacity.write(args.weights_out + int64_t(blockIdx.x) * weights, in);
  of_covariance.write(of_color.write(out, in), in);
}

}  // namespace
}  // namespace padgs

using namespace padgs;

// How many gradients of all weights are left to be added up.
PADGS_API int64_t padgs_cuda_networks_blocks(int64_t anchors) { return blocks_of_anchors(anchors); }

PADGS_API int padgs_cuda_networks_backward(const Queue *queue, const NetworkGradientArguments *args) {
  return on_device(*queue, [&] {
    const auto kernel = args->inputs.type == kFloat16 ? backward_kernel<Float16> : backward_kernel<Bfloat16>;
    launch(kernel, blocks_of_anchors(args->gradient.forward.anchors), kThreads, *queue, *args);
    return 0;
  });
}
