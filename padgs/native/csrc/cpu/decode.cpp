// Anchors to Gaussians and back in one pass each (paper Eq. 13-15): three small networks, selection, placement.
//
// Lanes are sixteen anchors. Nothing of the networks' insides is kept between the passes: computing the hidden layers
// again costs less than reading them. Sums over anchors (the gradients of the weights) are formed for blocks of a
// fixed number of anchors and added in order, so that they do not depend on the number of threads.
#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels.h"
#include "simd.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

constexpr int64_t kBlock = 1024;  // anchors per partial sum
constexpr int kGroups = 4;        // groups of sixteen anchors that share one visit to the sums

Vec sigmoid(Vec x) {
  const Vec limited = maximum(minimum(x, splat(60.0f)), splat(-60.0f));
  return 1.0f / (1.0f + exp2_fast(limited * -kLog2E));
}

// Rows o .. o + kRows - 1 of out = bias + weight in: each input is loaded once for all of them, and there are enough
// running sums to hide the latency of one.
template <int kRows>
void affine_rows(const float *weight, const float *bias, int o, int inputs, const Vec *in, Vec *out) {
  Vec sums[kRows];
  const float *rows = weight + size_t(o) * inputs;
  for (int r = 0; r < kRows; ++r) sums[r] = splat(bias[o + r]);
  for (int i = 0; i < inputs; ++i) {
    const Vec x = in[i];
    for (int r = 0; r < kRows; ++r) sums[r] += x * rows[r * inputs + i];
  }
  for (int r = 0; r < kRows; ++r) out[o + r] = sums[r];
}

void affine(const float *weight, const float *bias, int outputs, int inputs, const Vec *in, Vec *out) {
  int o = 0;
  for (; o + 10 <= outputs; o += 10) affine_rows<10>(weight, bias, o, inputs, in, out);
  for (; o + 4 <= outputs; o += 4) affine_rows<4>(weight, bias, o, inputs, in, out);
  for (; o < outputs; ++o) affine_rows<1>(weight, bias, o, inputs, in, out);
}

// out[i] += sum_o weight[o][i] grad[o], for the first `wanted` inputs.
void affine_transposed(const float *weight, int outputs, int inputs, int wanted, const Vec *grad, Vec *out) {
  int i = 0;
  for (; i + 8 <= wanted; i += 8) {
    Vec sums[8];
    for (int r = 0; r < 8; ++r) sums[r] = out[i + r];
    for (int o = 0; o < outputs; ++o)
      for (int r = 0; r < 8; ++r) sums[r] += grad[o] * weight[o * inputs + i + r];
    for (int r = 0; r < 8; ++r) out[i + r] = sums[r];
  }
  for (; i < wanted; ++i)
    for (int o = 0; o < outputs; ++o) out[i] += grad[o] * weight[o * inputs + i];
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
  // Several groups of anchors at once, so that each sum is loaded and stored once for all of them.
  void add(const Vec *const (&grad)[kGroups], const Vec *const (&in)[kGroups]) {
    for (int o = 0; o < outputs; ++o) {
      const Vec g0 = grad[0][o], g1 = grad[1][o], g2 = grad[2][o], g3 = grad[3][o];
      Vec *row = weight.data() + size_t(o) * inputs;
      for (int i = 0; i < inputs; ++i) row[i] += (g0 * in[0][i] + g1 * in[1][i]) + (g2 * in[2][i] + g3 * in[3][i]);
      bias[o] += (g0 + g1) + (g2 + g3);
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

// Sixteen anchors on their way through the networks. Lanes past the end repeat the last anchor.
struct Group {
  const DecodeArguments &args;
  int64_t first = 0;
  int lanes = 0;  // number of valid lanes
  std::vector<Vec> memory;
  Vec *inputs, *hidden, *outputs;  // [I], [hidden], [7 K]

  explicit Group(const DecodeArguments &a) : args(a), memory(a.inputs + a.hidden + 7 * a.offsets) {
    inputs = memory.data(), hidden = inputs + a.inputs, outputs = hidden + a.hidden;
  }
  void load_anchors(int64_t anchor) {
    first = anchor;
    lanes = int(std::min<int64_t>(kLanes, args.anchors - first));
    load_rows(args.input_rows, args.inputs, first, args.anchors, inputs);
  }
  void run_hidden(const HeadWeights &head) {
    affine(head.w1, head.b1, args.hidden, args.inputs, inputs, hidden);
    for (int h = 0; h < args.hidden; ++h) hidden[h] = select(less(hidden[h], zero()), zero(), hidden[h]);  // keeps NaN
  }
  void run(const HeadWeights &head, int count) {
    run_hidden(head);
    affine(head.w2, head.b2, count, args.hidden, hidden, outputs);
  }
};

// exp of the six log-scales of sixteen anchors, [6][lanes].
void reaches(const DecodeArguments &args, int64_t first, float *out) {
  Vec logs[6];
  load_rows(args.log_scales, 6, first, args.anchors, logs);
  for (int c = 0; c < 6; ++c)
    store(out + c * kLanes, exp2_fast(maximum(minimum(logs[c], splat(60.0f)), splat(-60.0f)) * kLog2E));
}

void opacities_of(const DecodeArguments &args, int64_t first, Group &group) {
  group.load_anchors(first);
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
void gaussians_of(const DecodeArguments &args, int64_t first, Group &group) {
  const int64_t end = std::min(first + kLanes, args.anchors);
  if (args.slot_start[first] == args.slot_start[end]) return;
  group.load_anchors(first);
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
  float all_reaches[6 * kLanes];
  reaches(args, first, all_reaches);
  for (int lane = 0; lane < group.lanes; ++lane) {
    const int64_t anchor = first + lane;
    int64_t n = args.slot_start[anchor];
    float reach[6];
    for (int c = 0; c < 6; ++c) reach[c] = all_reaches[c * kLanes + lane];
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

// Running sums of one network.
struct HeadSums {
  const HeadWeights &weights;
  LayerSums first, second;

  HeadSums(const DecodeArguments &args, const HeadWeights &w, int outputs)
      : weights(w), first(args.hidden, args.inputs), second(outputs, args.hidden) {}
};

class BlockBackward {
 public:
  explicit BlockBackward(const DecodeGradientArguments &args)
      : args_(args), forward_(args.forward), opacity_(forward_, forward_.opacity, forward_.offsets),
        color_(forward_, forward_.color, 3 * forward_.offsets),
        covariance_(forward_, forward_.covariance, 7 * forward_.offsets), groups_(kGroups, Group(forward_)) {
    for (Group &group : groups_) {  // copies share no memory: point each into its own
      group.inputs = group.memory.data(), group.hidden = group.inputs + forward_.inputs;
      group.outputs = group.hidden + forward_.hidden;
    }
    for (int g = 0; g < kGroups; ++g) {
      grads_[g].resize(size_t(11) * forward_.offsets * kLanes);
      grad_outputs_[g].resize(7 * forward_.offsets);
      grad_hidden_[g].resize(forward_.hidden);
      grad_inputs_[g].resize(args_.features);
    }
  }

  void run(int64_t block, float *weight_sums) {
    for (HeadSums *head : {&opacity_, &color_, &covariance_}) head->first.clear(), head->second.clear();
    const int64_t end = std::min(forward_.anchors, (block + 1) * kBlock);
    for (int64_t first = block * kBlock; first < end; first += kGroups * kLanes) groups(first);
    for (HeadSums *head : {&opacity_, &color_, &covariance_})
      weight_sums = head->second.store_sums(head->first.store_sums(weight_sums));
  }

 private:
  // Gradients arrive by slot; they are laid out as the networks' outputs, [11 K][lanes]: opacity, colour, covariance.
  void groups(int64_t first) {
    const int k = forward_.offsets;
    for (int g = 0; g < kGroups; ++g) {
      Group &group = groups_[g];
      group.load_anchors(std::min(first + g * kLanes, forward_.anchors - 1));
      if (first + g * kLanes >= forward_.anchors) group.lanes = 0;  // beyond the end: no anchor, no gradient
      std::fill(grads_[g].begin(), grads_[g].end(), 0.0f);
      std::fill(grad_inputs_[g].begin(), grad_inputs_[g].end(), zero());
      float all_reaches[6 * kLanes];
      reaches(forward_, group.first, all_reaches);
      for (int lane = 0; lane < group.lanes; ++lane)
        anchor(group.first + lane, grads_[g].data() + lane, all_reaches + lane);
    }
    head(opacity_, 0, k);
    head(color_, k, 3 * k);
    head(covariance_, 4 * k, 7 * k);
    for (int g = 0; g < kGroups; ++g)
      for (int f = 0; f < args_.features; ++f) {
        float lanes[kLanes];
        store(lanes, grad_inputs_[g][f]);
        for (int lane = 0; lane < groups_[g].lanes; ++lane)
          args_.features_out[(groups_[g].first + lane) * args_.features + f] = lanes[lane];
      }
  }

  // One network: from the gradients of its outputs to those of its weights and of the inputs.
  void head(HeadSums &sums, int at, int count) {
    const HeadWeights &w = sums.weights;
    const Vec *outputs[kGroups], *hidden[kGroups], *grad_hidden[kGroups], *inputs[kGroups];
    for (int g = 0; g < kGroups; ++g) {
      Group &group = groups_[g];
      group.run_hidden(w);
      for (int o = 0; o < count; ++o) grad_outputs_[g][o] = load(grads_[g].data() + size_t(at + o) * kLanes);
      std::fill(grad_hidden_[g].begin(), grad_hidden_[g].end(), zero());
      affine_transposed(w.w2, count, forward_.hidden, forward_.hidden, grad_outputs_[g].data(), grad_hidden_[g].data());
      for (int h = 0; h < forward_.hidden; ++h)
        grad_hidden_[g][h] = keep(less(zero(), group.hidden[h]), grad_hidden_[g][h]);
      affine_transposed(w.w1, forward_.hidden, forward_.inputs, args_.features, grad_hidden_[g].data(),
                        grad_inputs_[g].data());
      outputs[g] = grad_outputs_[g].data(), hidden[g] = group.hidden;
      grad_hidden[g] = grad_hidden_[g].data(), inputs[g] = group.inputs;
    }
    sums.second.add(outputs, hidden);
    sums.first.add(grad_hidden, inputs);
  }

  // Gradients of the selected Gaussians of an anchor: to its offsets and scales, and to the networks through `grads`.
  void anchor(int64_t anchor, float *grads, const float *lane_reaches) {
    const DecodeArguments &in = forward_;
    const int k = in.offsets;
    int64_t n = in.slot_start[anchor];
    float reach[6], grad_log[6] = {};
    for (int c = 0; c < 6; ++c) reach[c] = lane_reaches[c * kLanes];
    const auto grad = [&](int o) -> float & { return grads[size_t(o) * kLanes]; };
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
  HeadSums opacity_, color_, covariance_;
  std::vector<Group> groups_;
  std::vector<float> grads_[kGroups];
  std::vector<Vec> grad_outputs_[kGroups], grad_hidden_[kGroups], grad_inputs_[kGroups];
};

template <typename Visit>
void for_each_group(const DecodeArguments &args, Visit visit) {
#pragma omp parallel
  {
    Group group(args);
#pragma omp for schedule(dynamic, 8)
    for (int64_t first = 0; first < args.anchors; first += kLanes) visit(args, first, group);
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
