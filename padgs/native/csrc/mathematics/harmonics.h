// Real spherical harmonics of degrees 1 to 3 at a direction, in the order of padgs/geometry/harmonics.py, and the
// derivative of a weighted sum by the direction.
#pragma once

#include "scalar.h"

namespace padgs {

constexpr int kHarmonics = 15;  // of degrees 1 to 3; degree D has those below (D + 1)^2 - 1

constexpr float kDc = 0.28209479177387814f;                                      // degree 0
constexpr float kFirst = 0.4886025119029199f;                                    // sqrt(3 / 4pi)
constexpr float kSecond = 1.0925484305920792f, kZonal = 0.31539156525252005f;    // sqrt(15 / 4pi), sqrt(5 / 16pi)
constexpr float kOuter = 0.5900435899266435f, kMiddle = 2.890611442640554f;      // sqrt(35 / 32pi), sqrt(105 / 4pi)
constexpr float kInner = 0.4570457994644658f, kThird = 0.3731763325901154f;      // sqrt(21 / 32pi), sqrt(7 / 16pi)

// Values of the functions up to a degree, for one direction or sixteen.
template <int kDegree, class T>
PADGS_HD void harmonics(T x, T y, T z, T *value) {
  const T xx = x * x, yy = y * y, zz = z * z;
  value[0] = -kFirst * y;
  value[1] = kFirst * z;
  value[2] = -kFirst * x;
  if constexpr (kDegree > 1) {
    value[3] = kSecond * x * y;
    value[4] = -kSecond * y * z;
    value[5] = kZonal * (2 * zz - xx - yy);
    value[6] = -kSecond * x * z;
    value[7] = 0.5f * kSecond * (xx - yy);
  }
  if constexpr (kDegree > 2) {
    value[8] = -kOuter * y * (3 * xx - yy);
    value[9] = kMiddle * x * y * z;
    value[10] = -kInner * y * (4 * zz - xx - yy);
    value[11] = kThird * z * (2 * zz - 3 * xx - 3 * yy);
    value[12] = -kInner * x * (4 * zz - xx - yy);
    value[13] = 0.5f * kMiddle * z * (xx - yy);
    value[14] = -kOuter * x * (xx - 3 * yy);
  }
}

// Derivatives of sum_k weight[k] value[k] by x, y and z, as polynomials of three free variables.
template <int kDegree, class T>
PADGS_HD void harmonics_gradient(T x, T y, T z, const T *weight, T &dx, T &dy, T &dz) {
  const T *w = weight;
  dx = -kFirst * w[2];
  dy = -kFirst * w[0];
  dz = kFirst * w[1];
  if constexpr (kDegree > 1) {
    dx += kSecond * (y * w[3] - z * w[6] + x * w[7]) - 2 * kZonal * x * w[5];
    dy += kSecond * (x * w[3] - z * w[4] - y * w[7]) - 2 * kZonal * y * w[5];
    dz += -kSecond * (y * w[4] + x * w[6]) + 4 * kZonal * z * w[5];
  }
  if constexpr (kDegree > 2) {
    const T xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
    const T ring = 4 * zz - xx - yy;
    dx += -6 * kOuter * xy * w[8] + kMiddle * (yz * w[9] + xz * w[13]) + kInner * (2 * xy * w[10]) -
          6 * kThird * xz * w[11] - kInner * (ring - 2 * xx) * w[12] - 3 * kOuter * (xx - yy) * w[14];
    dy += -3 * kOuter * (xx - yy) * w[8] + kMiddle * (xz * w[9] - yz * w[13]) - kInner * (ring - 2 * yy) * w[10] -
          6 * kThird * yz * w[11] + kInner * (2 * xy * w[12]) + 6 * kOuter * xy * w[14];
    dz += kMiddle * (xy * w[9] + 0.5f * (xx - yy) * w[13]) - 8 * kInner * z * (y * w[10] + x * w[12]) +
          3 * kThird * (2 * zz - xx - yy) * w[11];
  }
}

}  // namespace padgs
