// Hybrid blending, backward. The derivative of a fragment needs its pixel's core and the sums over its tail, which the
// forward pass kept, but no other fragment: first a pixel turns its core into what derivatives need, then it visits the
// list of its tile.
#include "gradient_sums.cuh"

namespace padgs {
namespace {

constexpr float kNearlyInCore = 0.999f * kCoreAlphaMin;  // for rounding, which may differ from that of the forward pass

template <class Pixel>
struct HybridPixel {
  Upstream up{};
  TailGradient tail{};
  int end = 0;
  int core_size;
  const int32_t *core = nullptr;      // [core_size] Gaussians
  CoreGradient *gradients = nullptr;  // [core_size]

  __device__ HybridPixel(const BlendGradientInputs &args, const PixelPlace &place, int length)
      : core_size(args.forward.core_size) {
    if (!place.inside) return;
    const BlendInputs &forward = args.forward;
    const int64_t p = place.index;
    end = length;
    core = forward.core + p * core_size, gradients = args.core_gradients + p * core_size;
    const Tail sums = forward.tails[p];
    const Pixel pixel = pixel_at<Pixel>(forward, place);
    const float grad_t = load_upstream(args, p, up);

    float left = 1, coverage = 0;
    int filled = 0;
    for (; filled < core_size && core[filled] >= 0; ++filled) {
      const float alpha = smaller(quick_exp2(pixel.at(forward.footprints[core[filled]]).log2_alpha), kAlphaMax);
      const float weight = alpha * left;
      gradients[filled] = {left, weight};
      coverage += weight;
      left = left_behind(left, weight);
    }
    tail = {left * sums.opacity_per_alpha(), 0.0f, 0.0f, 0.0f};
    coverage += tail.unit * sums.alpha;
    if (args.grad_depth && coverage > 0) {
      up.depth = args.grad_depth[p] / coverage;
      tail.offset = -(up.depth * forward.depth[p]);
    }
    if (sums.alpha > 0) {
      const float each = 1.0f / sums.alpha;
      tail.mean = up.along(each * sums.red, each * sums.green, each * sums.blue, each * sums.depth) + tail.offset;
    }
    tail.behind = left * sums.left * (grad_t - tail.mean);
    float behind = tail.unit * sums.alpha * tail.mean + left * sums.left * grad_t;
    for (int k = filled - 1; k >= 0; --k) {
      const float weight = gradients[k].behind;
      gradients[k].behind = behind;
      behind += weight * (up.along(forward.footprints[core[k]]) + tail.offset);
    }
  }

  __device__ float step_back(const Footprint &f, int32_t gaussian, float log2_alpha, float &weight) const {
    const float full = quick_exp2(log2_alpha), alpha = smaller(full, kAlphaMax);
    float unit = tail.unit, mean = tail.mean, behind = tail.behind;
    if (alpha >= kNearlyInCore) {
      for (int k = 0; k < core_size && core[k] >= 0; ++k) {
        if (core[k] != gaussian) continue;
        unit = gradients[k].unit, mean = 0, behind = gradients[k].behind;
        break;
      }
    }
    weight = alpha * unit;
    const float signal = up.along(f) + tail.offset - mean;
    return full < kAlphaMax ? weight * signal - behind * (alpha * quick_inverse(1.0f - alpha)) : 0.0f;
  }
};

}  // namespace

void hybrid_backward(const Queue &queue, const BlendGradientInputs &args) {
  launch_gradient_sums<HybridPixel<PlanarPixel>, HybridPixel<ProjectivePixel>>(queue, args);
}

}  // namespace padgs
