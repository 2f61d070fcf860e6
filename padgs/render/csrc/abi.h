// The C ABI of libpadgs_cpu. Plain pointers and sizes; the caller (padgs/render/cpu_backend.py) allocates every buffer
// and has checked every shape. All floats are float32, all integers int32 unless they say otherwise.
#pragma once

#include <cstdint>

#if defined(_WIN32)
#define PADGS_API extern "C" __declspec(dllexport)
#else
#define PADGS_API extern "C" __attribute__((visibility("default")))
#endif

namespace padgs {

constexpr int kTile = 16;        // pixels on each side of a tile; one row of a tile is one vector of 16 lanes
constexpr int kMoments = 10;     // floats that backward blending leaves for each (Gaussian, tile) instance
constexpr float kAlphaMin = 1.0f / 255.0f;
constexpr float kAlphaMax = 0.99f;
constexpr float kTransmittanceMin = 1e-4f;

// What a camera and its options are to the kernels. Mirrored by `Camera` in native.py.
struct Camera {
  int32_t width, height;
  float cam_from_world[12];  // rows of [R | t]
  float near_radius;
  float low_pass;  // px^2
  int32_t wrap;    // 1: footprints continue across the +-180 degree seam
  int32_t square;  // 1: published bounds, a square of 3 sigma of the longest axis rounded out to tiles
};

// One projected Gaussian as the blender reads it. log2(alpha) at an offset (du, dv) from the centre is
// log2_opacity - (a du + b dv)^2 - (c dv)^2: a Cholesky factor of the conic, so that nothing cancels.
struct Footprint {
  float u, v;
  float a, b, c;
  float log2_opacity;
  float row_reach;  // |dv| beyond which alpha < 1/255 for every du
  float depth;
  float red, green, blue;
  float opacity;
};
static_assert(sizeof(Footprint) == 48, "padgs/render/cpu_backend.py allocates 12 floats per footprint");

// Tiles that a footprint touches: columns [first, end) and, after the seam, [0, second_end), of rows [row, row_end).
struct TileBox {
  int32_t column, column_end, second_end, row, row_end;
  int32_t count() const { return (column_end - column + second_end) * (row_end - row); }
};
static_assert(sizeof(TileBox) == 20, "padgs/render/cpu_backend.py allocates 5 integers per box");

struct Inputs {
  int64_t count;
  const float *means, *quats, *scales, *opacities, *colors;  // [N,3] [N,4] [N,3] [N] [N,3]
  const float *probe;                                         // [N,2] or null
};

struct Gradients {
  float *means, *quats, *scales, *opacities, *colors;  // as in Inputs, written not added to
  float *probe;                                        // [N,2] or null
  double *pose;                                        // [12] or null
};

struct BlendArguments {
  int32_t width, height;
  int32_t wrap;                          // as in Camera
  int32_t first_tile_row, end_tile_row;  // only these rows of tiles are drawn
  const Footprint *footprints;           // [N]
  const int64_t *tile_start;             // [tiles + 1] over the drawn tiles
  const int32_t *instances;              // [I] Gaussian of each instance, tile by tile, front to back
  const int64_t *slots;                  // [I] where the moments of an instance go
  const float *background;               // [3]
  float *image, *transmittance, *depth;  // [H,W,3] [H,W] [H,W]
  int32_t *last;                         // [H,W] 1 + position in the tile's list of the last contribution
  int64_t *pair_counts;                  // [tiles, 2] evaluated and contributing pairs
};

struct BlendGradientArguments {
  BlendArguments forward;
  const float *grad_image, *grad_transmittance, *grad_depth;  // [H,W,3] [H,W] or null, [H,W] or null
  float *moments;                                             // [I, kMoments] by slot
};

struct LossArguments {
  int32_t width, height;
  const float *image, *target;  // [H,W,3]
  const float *weight;          // [H,W], or fewer values with a stride of 0
  int64_t weight_row_stride, weight_column_stride;
  float lambda_l1;
  float normalizer;  // 1 / (sum of weights, times 3 for a mean over channels)
  float *workspace;  // padgs_loss_workspace(H, W) floats, zero before the first call
  float *gradient;   // [H,W,3], dL/dimage, or null
};

}  // namespace padgs
