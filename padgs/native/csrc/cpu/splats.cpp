// Parameters of explicit Gaussians to attributes for one view, and the derivatives: positions moved by offsets, e^x of
// log-scales, sigmoids of opacity logits, colours max(0, 1/2 + spherical harmonics).
// padgs.methods.splats.splats.Splats is the definition.
#include <algorithm>

#include "../mathematics/harmonics.h"
#include "items.h"
#include "kernels.h"
#include "simd_math.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

constexpr int kAxes = 3, kRgb = 3;

// Sixteen Gaussians relative to the camera, moved by offsets of no, three or four values.
struct Placed {
  Vec half;             // of the distance, before they are moved
  Vec moved[kAxes];     // world
  Vec ray[kAxes];       // direction
  Vec inverse;          // inverse length of the ray
  Vec absgrad = zero();    // the fourth value of the offsets, world units

  Placed(const SplatArguments &args, int64_t first) {
    Vec offsets[kAxes + 1] = {zero(), zero(), zero(), zero()};
    load_items<kAxes>(args.means, first, args.count, moved);
    if (args.offset_width == kAxes) load_items<kAxes>(args.offsets, first, args.count, offsets);
    if (args.offset_width > kAxes) load_items<kAxes + 1>(args.offsets, first, args.count, offsets);
    half = 0.5f * root(squared_distance(args));
    for (int c = 0; c < kAxes; ++c) moved[c] += half * offsets[c];
    absgrad = half * offsets[kAxes];
    inverse = 1.0f / root(squared_distance(args) + args.tiny * args.tiny);
    for (int c = 0; c < kAxes; ++c) ray[c] = ray[c] * inverse;
  }

 private:
  Vec squared_distance(const SplatArguments &args) {
    for (int c = 0; c < kAxes; ++c) ray[c] = moved[c] - args.center[c];
    return ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2];
  }
};

template <int kDegree>
struct Splats {
  static constexpr int kUsed = (kDegree + 1) * (kDegree + 1) - 1;
  using Lanes = float[kHarmonics][kLanes];

  // The functions at sixteen directions.
  static void functions(const Placed &placed, Lanes &lanes) {
    if constexpr (kDegree > 0) {
      Vec value[kHarmonics];
      harmonics<kDegree>(placed.ray[0], placed.ray[1], placed.ray[2], value);
      for (int k = 0; k < kUsed; ++k) store(lanes[k], value[k]);
    }
  }

  static void forward(const SplatArguments &args, int64_t first) {
    const int64_t count = args.count;
    Vec scale[kAxes], opacity[1];
    load_items<kAxes>(args.log_scales, first, count, scale);
    load_items<1>(args.opacity_logits, first, count, opacity);
    for (Vec &s : scale) s = exponential(s);
    opacity[0] = 1.0f / (1.0f + exponential(-opacity[0]));
    store_items<kAxes>(args.scales, first, count, scale);
    store_items<1>(args.opacities, first, count, opacity);
    const Placed placed(args, first);
    store_items<kAxes>(args.moved, first, count, placed.moved);
    if (args.absgrad) store_items<1>(args.absgrad, first, count, &placed.absgrad);
    Lanes value;
    functions(placed, value);
    const int end = int(std::min<int64_t>(kLanes, count - first));
    for (int i = 0; i < end; ++i) {
      const float *dc = args.dc + kRgb * (first + i), *rest = args.rest + kRgb * args.stored * (first + i);
      for (int c = 0; c < kRgb; ++c) {
        float sum = 0.5f + kDc * dc[c];
        for (int k = 0; k < kUsed; ++k) sum += value[k][i] * rest[kRgb * k + c];
        args.colors[kRgb * (first + i) + c] = std::max(sum, 0.0f);
      }
    }
  }

  static void backward(const SplatArguments &args, int64_t first) {
    const int64_t count = args.count;
    Vec scale[kAxes], opacity[1], grad[kAxes], grad_opacity[1];
    load_items<kAxes>(args.scales, first, count, scale);
    load_items<kAxes>(args.grad_scales, first, count, grad);
    for (int c = 0; c < kAxes; ++c) grad[c] = grad[c] * scale[c];
    store_items<kAxes>(args.grad_log_scales, first, count, grad);
    load_items<1>(args.opacities, first, count, opacity);
    load_items<1>(args.grad_opacities, first, count, grad_opacity);
    grad_opacity[0] = grad_opacity[0] * opacity[0] * (1.0f - opacity[0]);
    store_items<1>(args.grad_opacity_logits, first, count, grad_opacity);

    const Placed placed(args, first);
    Lanes value, weights;
    functions(placed, value);
    const int end = int(std::min<int64_t>(kLanes, count - first));
    for (int i = 0; i < end; ++i) gradients_of_coefficients(args, first + i, i, value, weights);
    load_items<kAxes>(args.grad_moved, first, count, grad);
    if constexpr (kDegree > 0) {  // the colour depends on the direction
      Vec function[kHarmonics], along[kAxes];
      for (int k = 0; k < kUsed; ++k) function[k] = load(weights[k]);
      harmonics_gradient<kDegree>(placed.ray[0], placed.ray[1], placed.ray[2], function, along[0], along[1], along[2]);
      Vec radial = zero();
      for (int c = 0; c < kAxes; ++c) radial += along[c] * placed.ray[c];
      for (int c = 0; c < kAxes; ++c) grad[c] += (along[c] - radial * placed.ray[c]) * placed.inverse;
    }
    store_items<kAxes>(args.grad_means, first, count, grad);
    Vec offsets[kAxes + 1] = {placed.half * grad[0], placed.half * grad[1], placed.half * grad[2], zero()};
    if (args.offset_width == kAxes) store_items<kAxes>(args.grad_offsets, first, count, offsets);
    if (args.offset_width > kAxes) {
      Vec absgrad[1];
      load_items<1>(args.grad_absgrad, first, count, absgrad);
      offsets[kAxes] = placed.half * absgrad[0];
      store_items<kAxes + 1>(args.grad_offsets, first, count, offsets);
    }
  }

  // Of Gaussian n, lane i; `weights` receives the derivative of the loss by each function.
  static void gradients_of_coefficients(const SplatArguments &args, int64_t n, int i, const Lanes &value, Lanes &weights) {
    float grad[kRgb];
    for (int c = 0; c < kRgb; ++c) {
      grad[c] = args.colors[kRgb * n + c] > 0 ? args.grad_colors[kRgb * n + c] : 0.0f;
      args.grad_dc[kRgb * n + c] = kDc * grad[c];
    }
    const float *rest = args.rest + kRgb * args.stored * n;
    float *grad_rest = args.grad_rest + kRgb * args.stored * n;
    for (int k = 0; k < kUsed; ++k) {
      for (int c = 0; c < kRgb; ++c) grad_rest[kRgb * k + c] = value[k][i] * grad[c];
      weights[k][i] = rest[kRgb * k] * grad[0] + rest[kRgb * k + 1] * grad[1] + rest[kRgb * k + 2] * grad[2];
    }
    std::fill(grad_rest + kRgb * kUsed, grad_rest + kRgb * args.stored, 0.0f);
  }
};

template <int kDegree>
void all(const SplatArguments &args) {
#pragma omp parallel for schedule(static)
  for (int64_t first = 0; first < args.count; first += kLanes) {
    if (args.grad_colors)
      Splats<kDegree>::backward(args, first);
    else
      Splats<kDegree>::forward(args, first);
  }
}

void splats(const SplatArguments &args) {
  void (*const of_degree[])(const SplatArguments &) = {all<0>, all<1>, all<2>, all<3>};
  of_degree[args.degree](args);
}

}  // namespace

extern const SplatKernels splat_kernels;
const SplatKernels splat_kernels = {splats};

}  // namespace PADGS_ISA
}  // namespace padgs
