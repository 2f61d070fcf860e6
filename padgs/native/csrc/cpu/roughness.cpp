// How rough the surfaces of a drawing are and the derivative by its distances, in one call.
// padgs.methods.plus.smoothness.define_roughness is the definition.
//
// Three passes over the rows: weights of neighbours, second differences of 1 / r across and down, and the derivatives.
// With v = (before + after) / here - 2 and the weight w of a place, the term w |v| has the derivative p = w sign(v) / here
// by both neighbours and -p (v + 2) by the place itself; above the jump it is constant.
#include <algorithm>
#include <vector>

#include "kernels.h"
#include "maps.h"

namespace padgs {
namespace PADGS_ISA {
namespace {

// Three neighbours, as the three maps of a place have them.
struct Neighbours {
  const float *before[3], *here[3], *after[3];
};

class Roughness {
 public:
  explicit Roughness(const RoughnessArguments &args)
      : args_(args),
        memory_(args.workspace),
        places_(memory_, 3, args.height, args.width),
        derivatives_(memory_, 2, args.height, args.width) {
    double all = 0, inner = 0;
    for (int y = 0; y < args.height; ++y) {
      all += args.row_weight[y];
      if (has_rows_around(y)) inner += args.row_weight[y];
    }
    across_ = float(1 / (all * (args.wrap ? args.width : args.width - 2)));
    down_ = float(1 / (inner * args.width));
  }

  void prepare(int y) {
    const int width = args_.width;
    const int64_t first = int64_t(y) * width;
    float *grey = places_.row(kGrey, y), *opacity = places_.row(kOpacity, y), *inverse = places_.row(kInverse, y);
    for (int x = 0; x < width; ++x) {
      const float *rgb = args_.image + 3 * (first + x);
      grey[x] = (rgb[0] + rgb[1] + rgb[2]) * (1 / 3.0f);
      opacity[x] = 1 - args_.transmittance[first + x];
      inverse[x] = 1 / std::max(args_.depth[first + x], args_.nearest);
    }
    for (float *row : {grey, opacity, inverse}) continue_around(row);
  }

  double bend(int y) {
    Vec total = zero();
    const float across = across_ * args_.row_weight[y], down = down_ * args_.row_weight[y];
    for (int x = 0; x < args_.width; x += kLanes) {
      const Mask inside = less(iota() + float(x), splat(float(args_.width)));
      total += terms(neighbours(y, x, 0, 1), inside, across, derivatives_.row(0, y) + x);
      if (has_rows_around(y)) total += terms(neighbours(y, x, 1, 0), inside, down, derivatives_.row(1, y) + x);
    }
    continue_around(derivatives_.row(0, y));
    return double(sum(total));
  }

  void write_gradient(int y) {
    const int64_t first = int64_t(y) * args_.width;
    for (int x = 0; x < args_.width; x += kLanes) {
      const float *p = derivatives_.row(0, y) + x, *inverse = places_.row(kInverse, y) + x;
      const Vec here = load(inverse);
      Vec derivative = load(p - 1) + load(p + 1) - load(p) * (load(inverse - 1) + load(inverse + 1)) / here;
      if (has_rows_around(y - 1)) derivative += load(derivatives_.row(1, y - 1) + x);
      if (has_rows_around(y + 1)) derivative += load(derivatives_.row(1, y + 1) + x);
      if (has_rows_around(y)) {
        const Vec before = load(places_.row(kInverse, y - 1) + x), after = load(places_.row(kInverse, y + 1) + x);
        derivative += -(load(derivatives_.row(1, y) + x) * (before + after) / here);
      }
      float lanes[kLanes];
      store(lanes, -(here * here * derivative));
      for (int i = 0; i < std::min(kLanes, args_.width - x); ++i)
        args_.gradient[first + x + i] = args_.depth[first + x + i] < args_.nearest ? 0.0f : lanes[i];
    }
  }

 private:
  enum { kGrey, kOpacity, kInverse };

  bool has_rows_around(int y) const { return y > 0 && y < args_.height - 1; }

  // Next to both ends of a row is the other end, or nothing.
  void continue_around(float *row) const {
    row[-1] = args_.wrap ? row[args_.width - 1] : 0.0f;
    row[args_.width] = args_.wrap ? row[0] : 0.0f;
  }

  Neighbours neighbours(int y, int x, int rows, int columns) {
    Neighbours found;
    for (int map = 0; map < 3; ++map) {
      found.before[map] = places_.row(map, y - rows) + x - columns;
      found.here[map] = places_.row(map, y) + x;
      found.after[map] = places_.row(map, y + rows) + x + columns;
    }
    return found;
  }

  // The terms of sixteen places; leaves the derivatives by their neighbours. Places at the border have a
  // neighbour without opacity and count nothing. Of two numbers `minimum` takes the second if one is no number, so what
  // may be none stands there: it has to reach the loss, which somebody looks at.
  Vec terms(const Neighbours &places, Mask inside, float weight, float *derivative) const {
    const auto outer = [&](int map) { return load(places.before[map]) + load(places.after[map]); };
    const Vec here = load(places.here[kInverse]);
    const Vec bright = magnitude_of(outer(kGrey) - 2.0f * load(places.here[kGrey]));
    const Vec excuse = exp2_fast(-minimum(splat(100.0f), bright * (args_.edges * kLog2E)));
    const Vec opacity = load(places.before[kOpacity]) * load(places.here[kOpacity]) * load(places.after[kOpacity]);
    const Vec counts = weight * opacity * excuse, bent = outer(kInverse) / here - 2.0f;
    const Vec size = magnitude_of(bent), jump = splat(args_.jump);
    const Vec sign = select(less(bent, zero()), splat(-1.0f), select(less(zero(), bent), splat(1.0f), zero()));
    store(derivative, keep(without(inside, less(jump, size)), counts * sign / here));
    return keep(inside, counts * minimum(jump, size));
  }

  static Vec magnitude_of(Vec a) { return maximum(a, -a); }

  const RoughnessArguments &args_;
  float *memory_;
  Maps places_, derivatives_;
  float across_, down_;
};

double roughness(const RoughnessArguments &args) {
  Roughness sweeps(args);
  std::vector<double> rows(args.height);
#pragma omp parallel
  {
#pragma omp for schedule(static)
    for (int y = 0; y < args.height; ++y) sweeps.prepare(y);
#pragma omp for schedule(static)
    for (int y = 0; y < args.height; ++y) rows[y] = sweeps.bend(y);
    if (args.gradient) {
#pragma omp for schedule(static)
      for (int y = 0; y < args.height; ++y) sweeps.write_gradient(y);
    }
  }
  double total = 0;
  for (double row : rows) total += row;
  return total;
}

int64_t roughness_workspace(int32_t height, int32_t width) {
  return 5 * int64_t(height) * int64_t(Maps::stride(width));
}

}  // namespace

extern const RoughnessKernels roughness_kernels;
const RoughnessKernels roughness_kernels = {roughness, roughness_workspace};

}  // namespace PADGS_ISA
}  // namespace padgs
