// The low-pass filters that widen a Gaussian in 3D, before it is projected: Sigma' = Sigma + widen r^2 I, a constant
// angle to the camera. With compensation the opacity shrinks by sqrt(det Sigma / det Sigma'), so that the Gaussian's
// mass stays. (Filters in pixels, and the tangent plane's own, belong to the footprints.)
#pragma once

#include "../abi.h"
#include "vector3.h"

namespace padgs {

template <class T>
struct Widened {
  CameraGaussian<T> gaussian;
  float widen;
  bool compensate;

  PADGS_HD Widened(const Camera &camera, const CameraGaussian<T> &g)
      : gaussian(g), widen(camera.widen), compensate(camera.compensate) {
    if (!(widen > 0)) return;
    const T add = widen * dot(g.mean, g.mean);
    const Vec3<T> s = g.scale;
    const Vec3<T> wide{root(s.x * s.x + add), root(s.y * s.y + add), root(s.z * s.z + add)};
    gaussian.scale = wide;
    if (compensate) gaussian.opacity = g.opacity * (s.x / wide.x) * (s.y / wide.y) * (s.z / wide.z);
  }

  // From the gradient of the widened Gaussian to that of `g`, in place: wide_i^2 = s_i^2 + widen |mu|^2, and
  // ln o' = ln o + sum(ln s_i - ln wide_i).
  PADGS_HD void vjp(const CameraGaussian<T> &g, CameraGaussianGradient<T> &grad) const {
    if (!(widen > 0)) return;
    const Vec3<T> s = g.scale, wide = gaussian.scale;
    // of ln s_i, and of half of wide_i^2
    const T kept = compensate ? grad.log_opacity : constant(0.0f, s.x);
    const Vec3<T> half{(grad.scale.x - kept / wide.x) / wide.x, (grad.scale.y - kept / wide.y) / wide.y,
                       (grad.scale.z - kept / wide.z) / wide.z};
    grad.scale = {half.x * s.x, half.y * s.y, half.z * s.z};
    if (compensate) grad.scale = grad.scale + Vec3<T>{kept / s.x, kept / s.y, kept / s.z};
    grad.mean = grad.mean + scaled(widen * (half.x + half.y + half.z), g.mean);
  }
};

}  // namespace padgs
