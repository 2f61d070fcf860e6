// Projection of all Gaussians, forward and backward: sixteen at a time, no shared state.
#include <algorithm>
#include <cstddef>
#include <cstring>
#include <vector>

#include "items.h"
#include "kernels.h"
#include "simd_math.h"

#include "../mathematics/footprint.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

constexpr int64_t kBlock = 1024;  // Gaussians per partial sum of the pose gradient; fixed, so that sums are too

// Sixteen Gaussians in the camera frame; offsets have moved those of projective footprints.
PosedGaussian<Vec> load_posed(const Camera &camera, const Inputs &in, int64_t first, MeanOffset<Vec> &offset) {
  Vec m[3], q[4], s[3], o[1], p[2] = {zero(), zero()};
  load_items<3>(in.means, first, in.count, m);
  load_items<4>(in.quats, first, in.count, q);
  load_items<3>(in.scales, first, in.count, s);
  load_items<1>(in.opacities, first, in.count, o);
  if (in.mean_offsets) load_items<2>(in.mean_offsets, first, in.count, p);
  offset = {p[0], p[1]};
  PosedGaussian<Vec> posed(camera.cam_from_world, {m[0], m[1], m[2]}, {q[0], q[1], q[2], q[3]}, {s[0], s[1], s[2]},
                           o[0]);
  if (in.mean_offsets && !planar(camera.projection)) posed.gaussian.mean = shifted_mean(posed.gaussian.mean, offset);
  return posed;
}

void forward_batch(const Camera &camera, const Inputs &in, int64_t first, Footprint *footprints, PixelBox *boxes) {
  MeanOffset<Vec> offset;
  const PosedGaussian<Vec> posed = load_posed(camera, in, first, offset);
  const Projected<Vec> all = projected(camera, posed.gaussian, offset);
  constexpr int kOwn = 13;  // values of a footprint besides its colour
  static_assert(sizeof all == (kOwn + 13) * sizeof(Vec) && offsetof(Footprint, red) == kOwn * sizeof(float));
  float footprint[kOwn][kLanes], drawn[kLanes], bounds[12][kLanes];
  std::memcpy(footprint, &all, sizeof footprint);
  store(drawn, all.drawn);
  std::memcpy(bounds, all.bounds, sizeof bounds);
  const int reads = planar(camera.projection) ? 6 : 12;
  const int end = int(std::min<int64_t>(kLanes, in.count - first));
  for (int lane = 0; lane < end; ++lane) {
    float bound[12];
    Footprint &f = footprints[first + lane];
    char *own = reinterpret_cast<char *>(&f);  // value by value: a vector would wait until all are written
    for (int k = 0; k < kOwn; ++k) std::memcpy(own + k * sizeof(float), &footprint[k][lane], sizeof(float));
    std::memcpy(&f.red, in.colors + 3 * (first + lane), 3 * sizeof(float));
    boxes[first + lane] = no_pixels();
    if (!(drawn[lane] > 0)) continue;
    for (int k = 0; k < reads; ++k) bound[k] = bounds[k][lane];
    const float centre[2] = {footprint[0][lane], footprint[1][lane]};
    boxes[first + lane] = box_of(camera, centre, bound);
  }
}

// Gradients of sixteen Gaussians from their gradient sums. Where all gradient sums are 0, so are the gradients.
void backward_batch(const Camera &camera, const Inputs &in, const float *sums, int64_t first, const Gradients &out,
                    double *pose) {
  MeanOffset<Vec> offset;
  const PosedGaussian<Vec> posed = load_posed(camera, in, first, offset);
  Vec m[kGradientSums], active = zero();
  load_items<kGradientSums>(sums, first, in.count, m);
  for (int k = 0; k < kGradientSums; ++k) active += magnitude(m[k]);
  const int end = int(std::min<int64_t>(kLanes, in.count - first));
  const Vec on = select(less(zero(), active), select(less(iota(), splat(float(end))), splat(1.0f), zero()), zero());
  const InputGradient<Vec> g = gradient_of(camera, posed, m, on);
  const Vec means[3] = {g.mean.x, g.mean.y, g.mean.z}, quats[4] = {g.quat.w, g.quat.x, g.quat.y, g.quat.z};
  const Vec scales[3] = {g.camera.scale.x, g.camera.scale.y, g.camera.scale.z}, opacities[1] = {g.opacity};
  const Vec colors[3] = {m[10], m[11], m[12]}, offset_values[2] = {g.offset.u, g.offset.v};
  store_items<3>(out.means, first, in.count, means);
  store_items<4>(out.quats, first, in.count, quats);
  store_items<3>(out.scales, first, in.count, scales);
  store_items<1>(out.opacities, first, in.count, opacities);
  store_items<3>(out.colors, first, in.count, colors);
  if (out.mean_offsets) store_items<2>(out.mean_offsets, first, in.count, offset_values);
  if (!pose) return;
  Vec entries[12];
  pose_gradient(posed, g.camera, on, entries);
  for (int k = 0; k < 12; ++k) pose[k] += sum(entries[k]);
}

void forward(const Camera &camera, const Inputs &in, Footprint *footprints, PixelBox *boxes) {
#pragma omp parallel for schedule(static)
  for (int64_t first = 0; first < in.count; first += kLanes) forward_batch(camera, in, first, footprints, boxes);
}

void backward(const Camera &camera, const Inputs &in, const float *gradient_sums, const Gradients &out) {
  const int64_t blocks = (in.count + kBlock - 1) / kBlock;
  std::vector<double> poses(out.pose ? 12 * blocks : 0, 0.0);
#pragma omp parallel for schedule(static)
  for (int64_t block = 0; block < blocks; ++block) {
    double *pose = out.pose ? poses.data() + 12 * block : nullptr;
    for (int64_t first = block * kBlock; first < std::min(in.count, (block + 1) * kBlock); first += kLanes)
      backward_batch(camera, in, gradient_sums, first, out, pose);
  }
  if (!out.pose) return;
  std::fill_n(out.pose, 12, 0.0);
  for (int64_t block = 0; block < blocks; ++block)
    for (int k = 0; k < 12; ++k) out.pose[k] += poses[12 * block + k];
}

}  // namespace

extern const ProjectKernels project_kernels;
const ProjectKernels project_kernels = {forward, backward};

}  // namespace PADGS_ISA
}  // namespace padgs
