// From a range of the image to whole pixels, for each kind of footprint: the pixels that one Gaussian can reach.
#pragma once

#include "../abi.h"
#include "bounds.h"

namespace padgs {

PADGS_HD float clamped(float x, float low, float high) { return smaller(larger(x, low), high); }
PADGS_HD int least(int a, int b) { return a < b ? a : b; }
PADGS_HD int most(int a, int b) { return a < b ? b : a; }
PADGS_HD PixelBox no_pixels() { return {0, 0, 0, 0, 0}; }

// The pixels whose centres lie in a range; empty where none does.
PADGS_HD PixelBox pixel_box(const Camera &camera, const PixelRange &range) {
  const int width = camera.width, height = camera.height;
  const int row = int(ceilf(clamped(range.v0 - 0.5f, -1.0f, float(height))));
  const int row_end = int(floored(clamped(range.v1 - 0.5f, -1.0f, float(height)))) + 1;
  PixelBox box{0, 0, 0, most(row, 0), least(row_end, height)};
  if (box.row >= box.row_end) return no_pixels();
  int column = int(ceilf(clamped(range.u0 - 0.5f, -2.0f * width, 3.0f * width)));
  int column_end = int(floored(clamped(range.u1 - 0.5f, -2.0f * width, 3.0f * width))) + 1;
  if (!camera.wrap) {
    column = most(column, 0);
    column_end = least(column_end, width);
  } else if (column_end - column >= width) {
    column = 0;
    column_end = width;
  }
  if (column >= column_end) return no_pixels();
  for (; column < 0; column += width) column_end += width;  // by the clamping above, no more
  for (; column >= width; column -= width) column_end -= width;  // than three times
  box.column = column;
  box.column_end = least(column_end, width);
  box.second_end = most(column_end - width, 0);
  return box;
}

PADGS_HD int square_edge(float p, int pixels) {
  return int(clamped(kTile * floored(p / kTile), 0.0f, float(pixels)));
}

// The published bounds: a square of 3 sigma of the longest axis, rounded out to 16-pixel tiles and cut at the borders.
// From half the trace and the determinant of a covariance in square pixels.
PADGS_HD PixelBox square_box(const Camera &camera, float u, float v, float middle, float determinant) {
  const float longest = middle + root(larger(middle * middle - determinant, 0.1f));
  const float radius = ceilf(3.0f * root(longest));
  const PixelBox box{square_edge(u - 0.5f - radius, camera.width),
                     square_edge(u - 0.5f + radius + kTile - 1, camera.width),
                     0, square_edge(v - 0.5f - radius, camera.height),
                     square_edge(v - 0.5f + radius + kTile - 1, camera.height)};
  return box.column < box.column_end && box.row < box.row_end ? box : no_pixels();
}

}  // namespace padgs
