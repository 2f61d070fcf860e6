// The colours that a view sees of explicit Gaussians, max(0, 1/2 + spherical harmonics), and their derivatives by means
// and coefficients. padgs.splats.model.Splats is the definition.
#include <algorithm>
#include <cmath>

#include "../mathematics/harmonics.h"
#include "kernels.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

constexpr int kBlock = 16;  // Gaussians that go through the arithmetic together
constexpr int kRgb = 3;

// The directions of a block, and what they are divided by.
struct Rays {
  float x[kBlock], y[kBlock], z[kBlock], inverse[kBlock];

  Rays(const ColorArguments &args, int64_t first, int count) {
    for (int i = 0; i < kBlock; ++i) {
      const float *mean = args.means + kRgb * (first + std::min(i, count - 1));
      const float rx = mean[0] - args.center[0], ry = mean[1] - args.center[1], rz = mean[2] - args.center[2];
      inverse[i] = 1 / std::sqrt(rx * rx + ry * ry + rz * rz + args.tiny * args.tiny);
      x[i] = rx * inverse[i], y[i] = ry * inverse[i], z[i] = rz * inverse[i];
    }
  }
};

template <int kDegree>
struct Colors {
  static constexpr int kUsed = (kDegree + 1) * (kDegree + 1) - 1;

  static void forward(const ColorArguments &args, int64_t first, int count) {
    float value[kBlock][kHarmonics];
    if constexpr (kDegree > 0) {
      const Rays rays(args, first, count);
      for (int i = 0; i < kBlock; ++i) harmonics<kDegree>(rays.x[i], rays.y[i], rays.z[i], value[i]);
    }
    for (int i = 0; i < count; ++i) {
      const float *dc = args.dc + kRgb * (first + i), *rest = args.rest + kRgb * args.stored * (first + i);
      for (int c = 0; c < kRgb; ++c) {
        float sum = 0.5f + kDc * dc[c];
        for (int k = 0; k < kUsed; ++k) sum += value[i][k] * rest[kRgb * k + c];
        args.colors[kRgb * (first + i) + c] = std::max(sum, 0.0f);
      }
    }
  }

  static void backward(const ColorArguments &args, int64_t first, int count) {
    float value[kBlock][kHarmonics], pull[kBlock][kHarmonics];
    if constexpr (kDegree > 0) {
      const Rays rays(args, first, count);
      for (int i = 0; i < kBlock; ++i) harmonics<kDegree>(rays.x[i], rays.y[i], rays.z[i], value[i]);
      for (int i = 0; i < count; ++i) gradients_of_coefficients(args, first + i, value[i], pull[i]);
      for (int i = 0; i < count; ++i) {
        float dx, dy, dz;
        harmonics_gradient<kDegree>(rays.x[i], rays.y[i], rays.z[i], pull[i], dx, dy, dz);
        const float along = dx * rays.x[i] + dy * rays.y[i] + dz * rays.z[i];
        float *mean = args.grad_means + kRgb * (first + i);
        mean[0] = (dx - along * rays.x[i]) * rays.inverse[i];
        mean[1] = (dy - along * rays.y[i]) * rays.inverse[i];
        mean[2] = (dz - along * rays.z[i]) * rays.inverse[i];
      }
    } else {
      for (int i = 0; i < count; ++i) gradients_of_coefficients(args, first + i, value[i], pull[i]);
      std::fill_n(args.grad_means + kRgb * first, kRgb * count, 0.0f);
    }
  }

  // `pull` [kUsed]: what the loss changes by with each value.
  static void gradients_of_coefficients(const ColorArguments &args, int64_t n, const float *value, float *pull) {
    float grad[kRgb];
    for (int c = 0; c < kRgb; ++c) {
      grad[c] = args.colors[kRgb * n + c] > 0 ? args.grad_colors[kRgb * n + c] : 0.0f;
      args.grad_dc[kRgb * n + c] = kDc * grad[c];
    }
    const float *rest = args.rest + kRgb * args.stored * n;
    float *grad_rest = args.grad_rest + kRgb * args.stored * n;
    for (int k = 0; k < kUsed; ++k) {
      pull[k] = 0;
      for (int c = 0; c < kRgb; ++c) {
        grad_rest[kRgb * k + c] = value[k] * grad[c];
        pull[k] += rest[kRgb * k + c] * grad[c];
      }
    }
    std::fill(grad_rest + kRgb * kUsed, grad_rest + kRgb * args.stored, 0.0f);
  }
};

template <int kDegree>
void all(const ColorArguments &args) {
#pragma omp parallel for schedule(static)
  for (int64_t first = 0; first < args.count; first += kBlock) {
    const int count = int(std::min<int64_t>(kBlock, args.count - first));
    if (args.grad_colors)
      Colors<kDegree>::backward(args, first, count);
    else
      Colors<kDegree>::forward(args, first, count);
  }
}

void colors(const ColorArguments &args) {
  void (*const of_degree[])(const ColorArguments &) = {all<0>, all<1>, all<2>, all<3>};
  of_degree[args.degree](args);
}

}  // namespace

extern const ColorKernels color_kernels;
const ColorKernels color_kernels = {colors};

}  // namespace PADGS_ISA
}  // namespace padgs
