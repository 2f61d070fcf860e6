// Parameters of explicit Gaussians to attributes for one view, and the derivatives, a thread each: positions moved by
// offsets, e^x of log-scales, sigmoids of opacity logits, colours max(0, 1/2 + spherical harmonics). splats.cpp of the
// CPU library does the same; padgs.methods.splats.splats.Splats is the definition.
#include "../mathematics/harmonics.h"
#include "../mathematics/vector3.h"
#include "arguments.h"
#include "device.cuh"

namespace padgs {
namespace {

constexpr int kThreads = 128, kRgb = 3;

// The coefficients above degree 0 of a block's Gaussians: most of what is moved, and side by side in memory. A row has an
// odd number of them in models of degree 1 and 3, so that the threads of a warp are at different banks.
struct Rows {
  float numbers[kThreads * kRgb * kHarmonics];

  // All threads of the block; from memory, before a barrier, or to it, behind one.
  __device__ void read(const float *from, int count) {
    for (int i = int(threadIdx.x); i < count; i += kThreads) numbers[i] = from[i];
  }
  __device__ void write(float *to, int count) const {
    for (int i = int(threadIdx.x); i < count; i += kThreads) to[i] = numbers[i];
  }
};

// State of a block.
struct Part {
  int64_t first;
  int count, width;  // Gaussians, and numbers of a row of coefficients

  __device__ explicit Part(const SplatArguments &args)
      : first(int64_t(blockIdx.x) * kThreads), count(kThreads), width(kRgb * args.stored) {
    if (args.count - first < kThreads) count = int(args.count - first);
  }
};

__device__ inline Vec3<float> vector_at(const float *values) { return {values[0], values[1], values[2]}; }
__device__ inline void store(float *to, Vec3<float> v) { to[0] = v.x, to[1] = v.y, to[2] = v.z; }

// A Gaussian relative to the camera, moved by offsets of no, three or four values.
struct Placed {
  float half;  // of the distance, before it is moved
  Vec3<float> moved, ray;
  float inverse;    // inverse length of the ray
  float absgrad = 0;  // the fourth value of the offsets, world units

  __device__ Placed(const DeviceSplatArguments &device, int64_t i) {
    const SplatArguments &args = device.splats;
    const Vec3<float> center = vector_at(device.center);
    const float *offsets = args.offsets + args.offset_width * i;
    moved = vector_at(args.means + 3 * i);
    ray = moved - center;
    half = 0.5f * root(dot(ray, ray));
    if (args.offset_width) moved = moved + scaled(half, vector_at(offsets));
    if (args.offset_width > 3) absgrad = half * offsets[3];
    ray = moved - center;
    inverse = 1.0f / root(dot(ray, ray) + args.tiny * args.tiny);
    ray = scaled(inverse, ray);
  }
};

template <int kDegree>
struct Functions {
  static constexpr int kUsed = (kDegree + 1) * (kDegree + 1) - 1;
  float values[kHarmonics];

  __device__ explicit Functions(const Placed &placed) {
    if constexpr (kDegree > 0) harmonics<kDegree>(placed.ray.x, placed.ray.y, placed.ray.z, values);
  }
};

template <int kDegree>
__global__ void __launch_bounds__(kThreads) splats_kernel(DeviceSplatArguments device) {
  typedef Functions<kDegree> Basis;
  const SplatArguments &args = device.splats;
  __shared__ Rows rows;
  const Part part(args);
  if (kDegree > 0) rows.read(args.rest + part.width * part.first, part.width * part.count);
  __syncthreads();
  const int own = int(threadIdx.x);
  const int64_t i = part.first + own;
  if (own >= part.count) return;
  const Placed placed(device, i);
  store(args.moved + 3 * i, placed.moved);
  if (args.absgrad) args.absgrad[i] = placed.absgrad;
  args.opacities[i] = 1.0f / (1.0f + expf(-args.opacity_logits[i]));
  const Basis basis(placed);
  const float *rest = rows.numbers + part.width * own;
  for (int c = 0; c < kRgb; ++c) {
    args.scales[3 * i + c] = expf(args.log_scales[3 * i + c]);
    float sum = 0.5f + kDc * args.dc[kRgb * i + c];
    for (int k = 0; k < Basis::kUsed; ++k) sum += basis.values[k] * rest[kRgb * k + c];
    args.colors[kRgb * i + c] = sum < 0 ? 0.0f : sum;
  }
}

template <int kDegree>
__global__ void __launch_bounds__(kThreads) splats_backward_kernel(DeviceSplatArguments device) {
  typedef Functions<kDegree> Basis;
  const SplatArguments &args = device.splats;
  __shared__ Rows rows;
  const Part part(args);
  if (kDegree > 0) rows.read(args.rest + part.width * part.first, part.width * part.count);
  __syncthreads();
  const int own = int(threadIdx.x);
  if (own < part.count) {
    const int64_t i = part.first + own;
    const Placed placed(device, i);
    const Basis basis(placed);
    float color[kRgb], by_function[kHarmonics];
    for (int c = 0; c < kRgb; ++c) {
      args.grad_log_scales[3 * i + c] = args.grad_scales[3 * i + c] * args.scales[3 * i + c];
      color[c] = args.colors[kRgb * i + c] > 0 ? args.grad_colors[kRgb * i + c] : 0.0f;
      args.grad_dc[kRgb * i + c] = kDc * color[c];
    }
    const float opacity = args.opacities[i];
    args.grad_opacity_logits[i] = args.grad_opacities[i] * opacity * (1.0f - opacity);

    float *rest = rows.numbers + part.width * own;  // which gradients take the place of
    for (int k = 0; k < Basis::kUsed; ++k) {
      float *of_function = rest + kRgb * k;
      by_function[k] = of_function[0] * color[0] + of_function[1] * color[1] + of_function[2] * color[2];
      for (int c = 0; c < kRgb; ++c) of_function[c] = basis.values[k] * color[c];
    }
    for (int n = kRgb * Basis::kUsed; n < part.width; ++n) rest[n] = 0;

    Vec3<float> grad = vector_at(args.grad_moved + 3 * i);
    if constexpr (kDegree > 0) {  // the colour depends on the direction
      Vec3<float> along;
      harmonics_gradient<kDegree>(placed.ray.x, placed.ray.y, placed.ray.z, by_function, along.x, along.y, along.z);
      grad = grad + scaled(placed.inverse, along - scaled(dot(along, placed.ray), placed.ray));
    }
    store(args.grad_means + 3 * i, grad);
    float *offsets = args.grad_offsets + args.offset_width * i;
    if (args.offset_width) store(offsets, scaled(placed.half, grad));
    if (args.offset_width > 3) offsets[3] = placed.half * args.grad_absgrad[i];
  }
  __syncthreads();
  rows.write(args.grad_rest + part.width * part.first, part.width * part.count);
}

}  // namespace
}  // namespace padgs

using namespace padgs;

// Backward where there are gradients of colours.
PADGS_API int padgs_cuda_splats(const Queue *queue, const DeviceSplatArguments *args) {
  return on_device(*queue, [&] {
    void (*const forward[])(DeviceSplatArguments) = {splats_kernel<0>, splats_kernel<1>, splats_kernel<2>,
                                                     splats_kernel<3>};
    void (*const backward[])(DeviceSplatArguments) = {splats_backward_kernel<0>, splats_backward_kernel<1>,
                                                      splats_backward_kernel<2>, splats_backward_kernel<3>};
    const auto kernel = (args->splats.grad_colors ? backward : forward)[args->splats.degree];
    launch(kernel, blocks_for(args->splats.count, kThreads), kThreads, *queue, *args);
    return 0;
  });
}
