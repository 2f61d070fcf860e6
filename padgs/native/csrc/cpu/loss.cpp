// The photometric loss (Eq. 16) and its derivative by the image in one call: L1 and SSIM under a weight map.
//
// Rows hold their channels interleaved, as images do: a neighbour in x is 3 floats away, so blurring needs no other
// layout. Four sweeps over the rows: blur along x, blur along y and compare, and the same two for the derivatives,
// because the window is symmetric and so is its zero padding. With S the SSIM and m_i, s_ii, s_it its window means,
//   dL/dx = blur(dL/dm_i) + 2 x blur(dL/ds_ii) + t blur(dL/ds_it) + the L1 part.
#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels.h"
#include "maps.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

constexpr int kHalf = 5;  // the window is 11 pixels long, sigma 1.5
constexpr int kChannels = 3;
static_assert(kHalf * kChannels <= kMargin, "the window looks no further than the margins reach");
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;

struct Window {
  float tap[kHalf + 1];  // by distance from the centre
  Window() {
    double total = 0, weight[kHalf + 1];
    for (int k = 0; k <= kHalf; ++k) {
      weight[k] = std::exp(-0.5 * k * k / (1.5 * 1.5));
      total += (k ? 2 : 1) * weight[k];
    }
    for (int k = 0; k <= kHalf; ++k) tap[k] = float(weight[k] / total);
  }
};
const Window kWindow;

Vec blur_x(const float *at) {
  Vec total = load(at) * kWindow.tap[0];
  for (int k = 1; k <= kHalf; ++k)
    total += (load(at - k * kChannels) + load(at + k * kChannels)) * kWindow.tap[k];
  return total;
}

Vec blur_y(Maps &maps, int map, int y, int x, int height) {
  Vec total = load(maps.row(map, y) + x) * kWindow.tap[0];
  for (int k = 1; k <= kHalf; ++k) {
    if (y - k >= 0) total += load(maps.row(map, y - k) + x) * kWindow.tap[k];
    if (y + k < height) total += load(maps.row(map, y + k) + x) * kWindow.tap[k];
  }
  return total;
}

// Sums of one row, before division by the total weight.
struct RowSums {
  double l1 = 0, dissimilarity = 0;
};

class Sweeps {
 public:
  explicit Sweeps(const LossArguments &args)
      : args_(args),
        length_(args.width * kChannels),
        memory_(args.workspace),
        inputs_(memory_, 2, args.height, length_),
        weights_(memory_, 1, args.height, length_),
        products_(memory_, 3, args.height, length_),
        blurred_(memory_, 5, args.height, length_),
        partials_(memory_, 3, args.height, length_) {}

  // Copies a row into padded storage and blurs image, target and their products along x.
  void blur_inputs(int y) {
    const float *image = args_.image + int64_t(y) * length_, *target = args_.target + int64_t(y) * length_;
    float *x = inputs_.row(0, y), *t = inputs_.row(1, y), *w = weights_.row(0, y);
    std::copy_n(image, length_, x);
    std::copy_n(target, length_, t);
    for (int column = 0; column < args_.width; ++column) {
      const float weight = args_.weight[int64_t(y) * args_.weight_row_stride + column * args_.weight_column_stride];
      std::fill_n(w + column * kChannels, kChannels, weight);
    }
    float *xx = products_.row(0, y), *tt = products_.row(1, y), *xt = products_.row(2, y);
    for (int i = 0; i < length_; ++i) {
      xx[i] = x[i] * x[i];
      tt[i] = t[i] * t[i];
      xt[i] = x[i] * t[i];
    }
    const float *sources[5] = {x, t, xx, tt, xt};
    for (int map = 0; map < 5; ++map)
      for (int i = 0; i < length_; i += kLanes) store(blurred_.row(map, y) + i, blur_x(sources[map] + i));
  }

  // Finishes the window means of a row, compares, and leaves dL/d(means) times the weight.
  RowSums compare(int y) {
    Vec l1 = zero(), dissimilarity = zero();
    const float share = args_.normalizer * (1 - args_.lambda_l1);
    for (int i = 0; i < length_; i += kLanes) {
      const Vec mx = blur_y(blurred_, 0, y, i, args_.height), mt = blur_y(blurred_, 1, y, i, args_.height);
      const Vec xx = blur_y(blurred_, 2, y, i, args_.height) - mx * mx;
      const Vec tt = blur_y(blurred_, 3, y, i, args_.height) - mt * mt;
      const Vec xt = blur_y(blurred_, 4, y, i, args_.height) - mx * mt;
      const Vec a1 = 2.0f * mx * mt + kC1, a2 = 2.0f * xt + kC2;
      const Vec b1 = mx * mx + mt * mt + kC1, b2 = xx + tt + kC2;
      const Vec inverse = 1.0f / (b1 * b2), similarity = a1 * a2 * inverse;
      const Vec w = load(weights_.row(0, y) + i);
      const Vec difference = load(inputs_.row(0, y) + i) - load(inputs_.row(1, y) + i);
      l1 += w * maximum(difference, -difference);
      dissimilarity += w * (1.0f - similarity);
      // dS/d(m_x), dS/d(E[x^2]), dS/d(E[x t]), with the variances written as differences.
      const Vec by_square = -(similarity / b2), by_product = 2.0f * a1 * inverse;
      const Vec by_mean = 2.0f * (mt * (a2 - a1) * inverse - mx * similarity * (1.0f / b1 - 1.0f / b2));
      const Vec scale = w * -share;
      store(partials_.row(0, y) + i, scale * by_mean);
      store(partials_.row(1, y) + i, scale * by_square);
      store(partials_.row(2, y) + i, scale * by_product);
    }
    return {double(sum(l1)), double(sum(dissimilarity))};
  }

  void blur_partials(int y) {
    for (int map = 0; map < 3; ++map)
      for (int i = 0; i < length_; i += kLanes) store(blurred_.row(map, y) + i, blur_x(partials_.row(map, y) + i));
  }

  void write_gradient(int y) {
    const float share = args_.normalizer * args_.lambda_l1;
    float *out = args_.gradient + int64_t(y) * length_;
    for (int i = 0; i < length_; i += kLanes) {
      const Vec x = load(inputs_.row(0, y) + i), t = load(inputs_.row(1, y) + i);
      const Vec sign = select(less(t, x), splat(share), select(less(x, t), splat(-share), zero()));
      const Vec g = blur_y(blurred_, 0, y, i, args_.height) + 2.0f * x * blur_y(blurred_, 1, y, i, args_.height) +
                    t * blur_y(blurred_, 2, y, i, args_.height) + load(weights_.row(0, y) + i) * sign;
      float lanes[kLanes];
      store(lanes, g);
      std::copy_n(lanes, std::min(kLanes, length_ - i), out + i);
    }
  }

 private:
  const LossArguments &args_;
  int length_;
  float *memory_;
  Maps inputs_, weights_, products_, blurred_, partials_;
};

// Lanes past the end of a row have weight 0 in every map, so they change no sum and blur nothing into the image.
double photometric_loss(const LossArguments &args) {
  Sweeps sweeps(args);
  std::vector<RowSums> rows(args.height);
#pragma omp parallel
  {
#pragma omp for schedule(static)
    for (int y = 0; y < args.height; ++y) sweeps.blur_inputs(y);
#pragma omp for schedule(static)
    for (int y = 0; y < args.height; ++y) rows[y] = sweeps.compare(y);
    if (args.gradient) {
#pragma omp for schedule(static)
      for (int y = 0; y < args.height; ++y) sweeps.blur_partials(y);
#pragma omp for schedule(static)
      for (int y = 0; y < args.height; ++y) sweeps.write_gradient(y);
    }
  }
  double total = 0;
  for (const RowSums &row : rows) total += args.lambda_l1 * row.l1 + (1 - args.lambda_l1) * row.dissimilarity;
  return total * args.normalizer;
}

int64_t loss_workspace(int32_t height, int32_t width) {
  return 14 * int64_t(height) * int64_t(Maps::stride(width * kChannels));
}

}  // namespace

extern const LossKernels loss_kernels;
const LossKernels loss_kernels = {photometric_loss, loss_workspace};

}  // namespace PADGS_ISA
}  // namespace padgs
