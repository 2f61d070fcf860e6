// Images in memory that whole vectors can walk over, with room for neighbours on both sides.
#pragma once

#include <cstddef>

#include "simd.h"

namespace padgs {
namespace PADGS_ISA {

constexpr int kMargin = kLanes;  // floats on both sides of a row, for neighbours at that distance at most

// A stack of maps over the image, rows padded to whole vectors with zero margins on the left and right. The memory is
// the caller's, zero at first; other values in the margins are written again at each call.
class Maps {
 public:
  Maps(float *&memory, int count, int height, int length) : height_(height), stride_(stride(length)), data_(memory) {
    memory += size_t(count) * height * stride_;
  }
  float *row(int map, int y) { return data_ + (size_t(map) * height_ + y) * stride_ + kMargin; }
  static size_t stride(int length) { return (length + kLanes - 1) / kLanes * kLanes + 2 * kMargin; }

 private:
  int height_;
  size_t stride_;
  float *data_;
};

}  // namespace PADGS_ISA
}  // namespace padgs
