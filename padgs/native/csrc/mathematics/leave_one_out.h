// Change of a pixel when one Gaussian is removed. It no longer shows c with weight w = alpha T, and what lies
// behind it, blended to B T (1 - alpha), shines through unattenuated: dC = alpha / (1 - alpha) behind - w c, exactly.
#pragma once

#include "vector3.h"

namespace padgs {

// One pixel on the way back, behind to front.
template <class T>
struct RemovalPixel {
  T transmittance;   // in front of the Gaussian visited last
  Vec3<T> behind;    // sum of w c behind it, background included
  Vec3<T> residual;  // image - target
  T weight;          // of the pixel's squared error
};

template <class T>
struct Removal {
  T contribution;  // w
  T change;        // weight |dC|^2
  T error;         // weight (|residual + dC|^2 - |residual|^2)
};

// Visits the next Gaussian in front; where alpha is 0 nothing changes.
template <class T>
PADGS_HD Removal<T> remove_one(RemovalPixel<T> &pixel, T alpha, Vec3<T> color) {
  const T inverse = reciprocal(1.0f - alpha);
  pixel.transmittance = pixel.transmittance * inverse;
  const T contribution = alpha * pixel.transmittance;
  const Vec3<T> shown = scaled(contribution, color), change = scaled(alpha * inverse, pixel.behind) - shown;
  pixel.behind = pixel.behind + shown;
  const T square = dot(change, change), across = dot(change, pixel.residual);
  return {contribution, pixel.weight * square, pixel.weight * (square + 2.0f * across)};
}

}  // namespace padgs
