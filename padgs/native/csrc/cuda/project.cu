// Projection of all Gaussians, a thread each, forward and backward.
#include "../mathematics/footprint.h"
#include "arguments.h"
#include "device.cuh"

namespace padgs {
namespace {

constexpr int kThreads = 128;
constexpr int kHistogram = 1024;  // rows of tiles that a block counts in shared memory: images of up to 16384 rows

__device__ PosedGaussian<float> load_posed(const Camera &camera, const float *pose, const Inputs &in, int64_t i,
                                           MeanOffset<float> &offset) {
  const float *m = in.means + 3 * i, *q = in.quats + 4 * i, *s = in.scales + 3 * i;
  PosedGaussian<float> posed(pose, {m[0], m[1], m[2]}, {q[0], q[1], q[2], q[3]}, {s[0], s[1], s[2]}, in.opacities[i]);
  offset = {0.0f, 0.0f};
  if (in.mean_offsets) offset = {in.mean_offsets[2 * i], in.mean_offsets[2 * i + 1]};
  if (in.mean_offsets && !planar(camera.projection)) posed.gaussian.mean = shifted_mean(posed.gaussian.mean, offset);
  return posed;
}

__device__ uint32_t bits_of(float x) {
  union {
    float number;
    uint32_t bits;
  } both = {x};
  return both.bits;
}

__global__ void __launch_bounds__(kThreads) project_kernel(ProjectArguments args) {
  __shared__ unsigned histogram[kHistogram + 1];
  const int rows = args.table.end_row, counted = least(rows, kHistogram);
  for (int k = int(threadIdx.x); k <= counted; k += kThreads) histogram[k] = 0;  // the last: how many are drawn
  __syncthreads();
  const int64_t i = global_thread();
  if (i < args.in.count) {
    MeanOffset<float> offset;
    const PosedGaussian<float> posed = load_posed(args.camera, args.pose, args.in, i, offset);
    const Projected<float> p = projected(args.camera, posed.gaussian, offset);
    const PixelBox box = p.drawn > 0 ? box_of(args.camera, p.shape, p.bounds) : no_pixels();
    const bool seen = box.row < box.row_end;
    Footprint f;
    for (int k = 0; k < 11; ++k) f.shape[k] = p.shape[k];
    const float *color = args.in.colors + 3 * i;
    f.log2_opacity = p.log2_opacity, f.depth = p.depth, f.red = color[0], f.green = color[1], f.blue = color[2];
    args.footprints[i] = f;
    args.boxes[i] = box;
    args.depth_keys[i] = seen ? bits_of(p.depth) : kAllLanes;  // positive floats order as their bits do
    args.indices[i] = int32_t(i);
    if (seen) atomicAdd(histogram + counted, 1u);
    const unsigned tiles = seen ? tiles_in_row(box) : 0;
    for (int row = box.row / kTile; seen && row <= (box.row_end - 1) / kTile; ++row) {
      if (row < counted)
        atomicAdd(histogram + row, tiles);
      else
        atomicAdd(args.counts + row, (unsigned long long)tiles);
    }
  }
  __syncthreads();
  for (int k = int(threadIdx.x); k <= counted; k += kThreads)
    if (histogram[k]) atomicAdd(args.counts + (k < counted ? k : rows), (unsigned long long)histogram[k]);
}

__global__ void __launch_bounds__(kThreads) project_backward_kernel(ProjectGradientArguments args) {
  __shared__ double partial[kThreads / kWarp][12];
  const int64_t i = global_thread();
  float pose[12] = {};
  if (i < args.in.count) {
    MeanOffset<float> offset;
    const PosedGaussian<float> posed = load_posed(args.camera, args.pose, args.in, i, offset);
    float m[kGradientSums], active = 0;
    for (int k = 0; k < kGradientSums; ++k) m[k] = args.gradient_sums[i * kGradientSums + k], active += magnitude(m[k]);
    const float on = active > 0 ? 1.0f : 0.0f;
    const InputGradient<float> g = gradient_of(args.camera, posed, m, on);
    const Vec3<float> scale = g.camera.scale;
    float *means = args.out.means + 3 * i, *quats = args.out.quats + 4 * i, *scales = args.out.scales + 3 * i;
    float *colors = args.out.colors + 3 * i;
    means[0] = g.mean.x, means[1] = g.mean.y, means[2] = g.mean.z;
    quats[0] = g.quat.w, quats[1] = g.quat.x, quats[2] = g.quat.y, quats[3] = g.quat.z;
    scales[0] = scale.x, scales[1] = scale.y, scales[2] = scale.z;
    args.out.opacities[i] = g.opacity;
    colors[0] = m[10], colors[1] = m[11], colors[2] = m[12];
    if (args.out.mean_offsets) args.out.mean_offsets[2 * i] = g.offset.u, args.out.mean_offsets[2 * i + 1] = g.offset.v;
    if (args.out.pose) pose_gradient(posed, g.camera, on, pose);
  }
  if (!args.out.pose) return;
  for (int k = 0; k < 12; ++k) {
    const double sum = warp_sum(double(pose[k]));
    if (lane_index() == 0) partial[threadIdx.x / kWarp][k] = sum;
  }
  __syncthreads();
  if (threadIdx.x >= 12) return;
  double sum = 0;
  for (int warp = 0; warp < kThreads / kWarp; ++warp) sum += partial[warp][threadIdx.x];
  args.out.pose[12 * int64_t(blockIdx.x) + threadIdx.x] = sum;
}

}  // namespace
}  // namespace padgs

using namespace padgs;

PADGS_API int padgs_cuda_project(const Queue *queue, const ProjectArguments *args) {
  return on_device(*queue, [&] {
    launch(project_kernel, blocks_for(args->in.count, kThreads), kThreads, *queue, *args);
    return 0;
  });
}

// Blocks of the kernel below, each of which leaves a partial sum of the pose gradient.
PADGS_API int64_t padgs_cuda_pose_blocks(int64_t count) { return blocks_for(count, kThreads); }

PADGS_API int padgs_cuda_project_backward(const Queue *queue, const ProjectGradientArguments *args) {
  return on_device(*queue, [&] {
    launch(project_backward_kernel, padgs_cuda_pose_blocks(args->in.count), kThreads, *queue, *args);
    return 0;
  });
}
