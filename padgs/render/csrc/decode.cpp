// Anchors to Gaussians and back in one pass each (paper Eq. 13-15): three small networks, selection, placement.
//
// Lanes are sixteen anchors. Nothing of the networks' insides is kept between the passes: computing the hidden layers again
// costs less than reading them. Sums over anchors (the gradients of the weights) are formed for blocks of a fixed number
// of anchors and added in order, so that they do not depend on the number of threads.
#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels.h"
#include "simd.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

constexpr int64_t kBlock = 1024;  // anchors per partial sum
constexpr float kLog2E = 1.44269504088896341f;

Vec sigmoid(Vec x) {
  const Vec limited = maximum(minimum(x, splat(60.0f)), splat(-60.0f));
  return 1.0f / (1.0f + exp2_fast(limited * -kLog2E));
}

// out[o] = bias[o] + sum_i weight[o][i] in[i], several rows at a time so that each input is loaded once for them.
void affine(const float *weight, const float *bias, int outputs, int inputs, const Vec *in, Vec *out) {
  int o = 0;
  for (; o + 4 <= outputs; o += 4) {
    const float *w0 = weight + o * inputs, *w1 = w0 + inputs, *w2 = w1 + inputs, *w3 = w2 + inputs;
    Vec a = splat(bias[o]), b = splat(bias[o + 1]), c = splat(bias[o + 2]), d = splat(bias[o + 3]);
    for (int i = 0; i < inputs; ++i) {
      const Vec x = in[i];
      a += x * w0[i], b += x * w1[i], c += x * w2[i], d += x * w3[i];
    }
    out[o] = a, out[o + 1] = b, out[o + 2] = c, out[o + 3] = d;
  }
  for (; o < outputs; ++o) {
    Vec a = splat(bias[o]);
    for (int i = 0; i < inputs; ++i) a += in[i] * weight[o * inputs + i];
    out[o] = a;
  }
}

// out[i] += sum_o weight[o][i] grad[o], for the first `wanted` inputs.
void affine_transposed(const float *weight, int outputs, int inputs, int wanted, const Vec *grad, Vec *out) {
  int o = 0;
  for (; o + 4 <= outputs; o += 4) {
    const float *w0 = weight + o * inputs, *w1 = w0 + inputs, *w2 = w1 + inputs, *w3 = w2 + inputs;
    const Vec a = grad[o], b = grad[o + 1], c = grad[o + 2], d = grad[o + 3];
    for (int i = 0; i < wanted; ++i) out[i] = out[i] + a * w0[i] + b * w1[i] + c * w2[i] + d * w3[i];
  }
  for (; o < outputs; ++o)
    for (int i = 0; i < wanted; ++i) out[i] += grad[o] * weight[o * inputs + i];
}

// Running sums, lane by lane, of the gradients of one layer.
struct LayerSums {
  int outputs, inputs;
  std::vector<Vec> weight, bias;

  LayerSums(int o, int i) : outputs(o), inputs(i), weight(size_t(o) * i), bias(o) { clear(); }
  void clear() {
    std::fill(weight.begin(), weight.end(), zero());
    std::fill(bias.begin(), bias.end(), zero());
  }
  void add(const Vec *grad, const Vec *in) {
    for (int o = 0; o < outputs; ++o) {
      const Vec g = grad[o];
      Vec *row = weight.data() + size_t(o) * inputs;
      for (int i = 0; i < inputs; ++i) row[i] += g * in[i];
      bias[o] += g;
    }
  }
  float *store_sums(float *out) const {
    for (const Vec &w : weight) *out++ = sum(w);
    for (const Vec &b : bias) *out++ = sum(b);
    return out;
  }
};

// Loads column by column what sixteen anchors have in rows of `width` floats; rows past the end repeat the last one.
void load_rows(const float *rows, int width, int64_t first, int64_t count, Vec *out) {
  float lanes[kLanes];
  for (int k = 0; k < width; ++k) {
    for (int lane = 0; lane < kLanes; ++lane) lanes[lane] = rows[std::min(first + lane, count - 1) * width + k];
    out[k] = load(lanes);
  }
}

// Sixteen anchors on their way through the networks.
struct Group {
  const DecodeArguments &args;
  int64_t first;
  int lanes;  // of them that exist
  std::vector<Vec> &memory;
  Vec *inputs, *hidden, *outputs;  // [I], [hidden], [7 K]

  Group(const DecodeArguments &a, int64_t f, std::vector<Vec> &m)
      : args(a), first(f), lanes(int(std::min<int64_t>(kLanes, a.anchors - f))), memory(m) {
    memory.resize(a.inputs + a.hidden + 7 * a.offsets);
    inputs = memory.data(), hidden = inputs + a.inputs, outputs = hidden + a.hidden;
    load_rows(a.input_rows, a.inputs, first, a.anchors, inputs);
  }
  void run(const HeadWeights &head, int count) {
    affine(head.w1, head.b1, args.hidden, args.inputs, inputs, hidden);
    for (int h = 0; h < args.hidden; ++h) hidden[h] = maximum(hidden[h], zero());
    affine(head.w2, head.b2, count, args.hidden, hidden, outputs);
  }
};

void opacities_of(const DecodeArguments &args, int64_t first, std::vector<Vec> &memory) {
  Group group(args, first, memory);
  const int k = args.offsets;
  group.run(args.opacity, k);
  int32_t selected[kLanes] = {};
  for (int o = 0; o < k; ++o) {
    float logits[kLanes], values[kLanes];
    store(logits, group.outputs[o]);
    store(values, 2.0f * sigmoid(group.outputs[o] * 2.0f) - 1.0f);
    for (int lane = 0; lane < group.lanes; ++lane) {
      // Near 0 the difference loses the sign, and the sign selects.
      const float value = std::fabs(logits[lane]) < 1e-3f ? logits[lane] : values[lane];
      args.raw_opacities[(first + lane) * k + o] = value;
      selected[lane] += value > 0;
    }
  }
  for (int lane = 0; lane < group.lanes; ++lane) args.slot_start[first + lane + 1] = selected[lane];
}

// Places the Gaussians of an anchor, with the decoded values of lane `lane`.
void gaussians_of(const DecodeArguments &args, int64_t first, std::vector<Vec> &memory) {
  const int64_t end = std::min(first + kLanes, args.anchors);
  if (args.slot_start[first] == args.slot_start[end]) return;
  Group group(args, first, memory);
  const int k = args.offsets;
  std::vector<float> values(size_t(kLanes) * 10 * k);  // [10 K][lanes]: colour 3 K, then covariance 7 K
  const auto keep_outputs = [&](int count, int at, int activated_of_seven) {
    for (int o = 0; o < count; ++o)
      store(values.data() + size_t(at + o) * kLanes,
            o % 7 < activated_of_seven ? sigmoid(group.outputs[o]) : group.outputs[o]);
  };
  group.run(args.color, 3 * k);
  keep_outputs(3 * k, 0, 7);
  group.run(args.covariance, 7 * k);
  keep_outputs(7 * k, 3 * k, 3);
  for (int lane = 0; lane < group.lanes; ++lane) {
    const int64_t anchor = first + lane;
    int64_t n = args.slot_start[anchor];
    float reach[6];
    for (int c = 0; c < 6; ++c) reach[c] = std::exp(args.log_scales[6 * anchor + c]);
    const auto value = [&](int o) { return values[size_t(o) * kLanes + lane]; };
    for (int i = 0; i < k; ++i) {
      const float raw = args.raw_opacities[anchor * k + i];
      if (!(raw > 0)) continue;
      args.slots[n] = anchor * k + i;
      args.opacities[n] = raw * args.attenuation[anchor];
      for (int c = 0; c < 3; ++c) {
        args.means[3 * n + c] = args.positions[3 * anchor + c] + reach[c] * args.offset_rows[3 * (anchor * k + i) + c];
        args.scales[3 * n + c] = reach[3 + c] * value(3 * k + 7 * i + c);
        args.colors[3 * n + c] = value(3 * i + c);
      }
      for (int c = 0; c < 4; ++c) args.quats[4 * n + c] = value(3 * k + 7 * i + 3 + c);
      ++n;
    }
  }
}

// One head's share of the backward pass: gradients of its outputs to its weights, and on to the inputs.
struct HeadBackward {
  const HeadWeights &weights;
  LayerSums first, second;

  HeadBackward(const DecodeArguments &args, const HeadWeights &w, int outputs)
      : weights(w), first(args.hidden, args.inputs), second(outputs, args.hidden) {}
  void add(const Group &group, const Vec *grad_outputs, Vec *grad_hidden, Vec *grad_inputs, int features) {
    const DecodeArguments &args = group.args;
    second.add(grad_outputs, group.hidden);
    std::fill_n(grad_hidden, args.hidden, zero());
    affine_transposed(weights.w2, second.outputs, args.hidden, args.hidden, grad_outputs, grad_hidden);
    for (int h = 0; h < args.hidden; ++h) grad_hidden[h] = keep(less(zero(), group.hidden[h]), grad_hidden[h]);
    first.add(grad_hidden, group.inputs);
    affine_transposed(weights.w1, args.hidden, args.inputs, features, grad_hidden, grad_inputs);
  }
};

class BlockBackward {
 public:
  explicit BlockBackward(const DecodeGradientArguments &args)
      : args_(args), forward_(args.forward), opacity_(forward_, forward_.opacity, forward_.offsets),
        color_(forward_, forward_.color, 3 * forward_.offsets),
        covariance_(forward_, forward_.covariance, 7 * forward_.offsets), grad_hidden_(forward_.hidden),
        grad_inputs_(forward_.inputs), grads_(size_t(11) * forward_.offsets * kLanes), grad_outputs_(7 * forward_.offsets) {}

  void run(int64_t block, float *weight_sums) {
    for (HeadBackward *head : {&opacity_, &color_, &covariance_}) head->first.clear(), head->second.clear();
    const int64_t end = std::min(forward_.anchors, (block + 1) * kBlock);
    for (int64_t first = block * kBlock; first < end; first += kLanes) group(first);
    for (HeadBackward *head : {&opacity_, &color_, &covariance_})
      weight_sums = head->second.store_sums(head->first.store_sums(weight_sums));
  }

 private:
  // Gradients arrive by slot; they are laid out as the networks' outputs, [11 K][lanes]: opacity, colour, covariance.
  void group(int64_t first) {
    const int k = forward_.offsets;
    Group group(forward_, first, memory_);
    std::fill(grads_.begin(), grads_.end(), 0.0f);
    std::fill(grad_inputs_.begin(), grad_inputs_.end(), zero());
    for (int lane = 0; lane < group.lanes; ++lane) anchor(first + lane, lane);
    const auto head = [&](HeadBackward &backward, int at, int count) {
      group.run(backward.weights, count);
      for (int o = 0; o < count; ++o) grad_outputs_[o] = load(grads_.data() + size_t(at + o) * kLanes);
      backward.add(group, grad_outputs_.data(), grad_hidden_.data(), grad_inputs_.data(), args_.features);
    };
    head(opacity_, 0, k);
    head(color_, k, 3 * k);
    head(covariance_, 4 * k, 7 * k);
    for (int f = 0; f < args_.features; ++f) {
      float lanes[kLanes];
      store(lanes, grad_inputs_[f]);
      for (int lane = 0; lane < group.lanes; ++lane) args_.features_out[(first + lane) * args_.features + f] = lanes[lane];
    }
  }

  void anchor(int64_t anchor, int lane) {
    const DecodeArguments &in = forward_;
    const int k = in.offsets;
    int64_t n = in.slot_start[anchor];
    float reach[6], grad_log[6] = {};
    for (int c = 0; c < 6; ++c) reach[c] = std::exp(in.log_scales[6 * anchor + c]);
    const auto grad = [&](int o) -> float & { return grads_[size_t(o) * kLanes + lane]; };
    for (int i = 0; i < k; ++i) {
      const int64_t slot = anchor * k + i;
      float *grad_offset = args_.offsets_out + 3 * slot;
      const float raw = in.raw_opacities[slot];
      if (!(raw > 0)) {
        std::fill_n(grad_offset, 3, 0.0f);
        continue;
      }
      grad(i) = args_.opacities[n] * in.attenuation[anchor] * (1 - raw * raw);
      for (int c = 0; c < 3; ++c) {
        const float color = in.colors[3 * n + c], scale = in.scales[3 * n + c];
        const float grad_mean = args_.means[3 * n + c], grad_scale = args_.scales[3 * n + c];
        grad(k + 3 * i + c) = args_.colors[3 * n + c] * color * (1 - color);
        // scale = reach * s with s a sigmoid: ds = scale (1 - s).
        grad(4 * k + 7 * i + c) = grad_scale * scale * (1 - scale / reach[3 + c]);
        grad_log[3 + c] += grad_scale * scale;
        grad_log[c] += grad_mean * reach[c] * in.offset_rows[3 * slot + c];
        grad_offset[c] = grad_mean * reach[c];
      }
      for (int c = 0; c < 4; ++c) grad(4 * k + 7 * i + 3 + c) = args_.quats[4 * n + c];
      ++n;
    }
    std::copy_n(grad_log, 6, args_.log_scales_out + 6 * anchor);
  }

  const DecodeGradientArguments &args_;
  const DecodeArguments &forward_;
  HeadBackward opacity_, color_, covariance_;
  std::vector<Vec> memory_, grad_hidden_, grad_inputs_;
  std::vector<float> grads_;
  std::vector<Vec> grad_outputs_;
};

template <typename Visit>
void for_each_group(const DecodeArguments &args, Visit visit) {
#pragma omp parallel
  {
    std::vector<Vec> memory;
#pragma omp for schedule(dynamic, 8)
    for (int64_t first = 0; first < args.anchors; first += kLanes) visit(args, first, memory);
  }
}

void select(const DecodeArguments &args) {
  args.slot_start[0] = 0;
  for_each_group(args, opacities_of);
  for (int64_t a = 0; a < args.anchors; ++a) args.slot_start[a + 1] += args.slot_start[a];
}

void place(const DecodeArguments &args) { for_each_group(args, gaussians_of); }

void backward(const DecodeGradientArguments &args) {
  const DecodeArguments &in = args.forward;
  const int64_t per_head = int64_t(in.hidden) * (in.inputs + 1), k = in.offsets;
  const int64_t size = 3 * per_head + 11 * k * (in.hidden + 1), blocks = (in.anchors + kBlock - 1) / kBlock;
  std::vector<float> sums(size_t(size * blocks));
#pragma omp parallel
  {
    BlockBackward worker(args);
#pragma omp for schedule(dynamic, 1)
    for (int64_t block = 0; block < blocks; ++block) worker.run(block, sums.data() + size * block);
  }
  for (int64_t i = 0; i < size; ++i) {
    double total = 0;
    for (int64_t block = 0; block < blocks; ++block) total += sums[size_t(size * block + i)];
    args.weights_out[i] = float(total);
  }
}

}  // namespace

extern const DecodeKernels decode_kernels;
const DecodeKernels decode_kernels = {select, place, backward};

}  // namespace PADGS_ISA
}  // namespace padgs
