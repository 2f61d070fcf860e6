// The C ABI of libpadgs_cpu. Plain pointers and sizes; the caller, in Python, allocates every buffer
// and has checked every shape. All floats are float32, all integers int32 unless they say otherwise.
#pragma once

#include <cstdint>

#if defined(_WIN32)
#define PADGS_API extern "C" __declspec(dllexport)
#else
#define PADGS_API extern "C" __attribute__((visibility("default")))
#endif

namespace padgs {

constexpr int kPatchWidth = 8, kPatchHeight = 2;  // pixels of a patch, which is one vector
constexpr int kTile = 16;        // pixels: height of a tile, and its width times a power of two
constexpr int kMaxLevel = 4;     // tiles are up to kTile 2^kMaxLevel pixels wide, near the poles
constexpr int kGradientSums = 16;  // floats that backward blending writes for each (Gaussian, tile) instance
constexpr int kAbsgradSum = 14;  // index of the absolute positional gradient
constexpr int kRemoval = 4;      // floats for each instance: changes of error and image, sum and largest contribution
constexpr float kAlphaMin = 1.0f / 255.0f;
constexpr float kAlphaMax = 0.99f;
constexpr float kTransmittanceMin = 1e-4f;
constexpr float kCoreAlphaMin = 0.05f;  // hybrid: fainter fragments belong to the tail
constexpr int kMaxCoreSize = 256;       // hybrid
constexpr float kNearest = 1e-15f, kFurthest = 1e15f;  // distances of means that are drawn; see padgs/render/contract.py

enum Projection : int32_t { kErp = 0, kPinhole = 1, kTangent = 2, kRay = 3 };
enum CameraModel : int32_t { kPanoramaModel = 0, kPinholeModel = 1, kTableModel = 2 };

// Camera and options as kernels take them. Mirrored by `NativeCamera` in padgs/native/abi.py.
struct Camera {
  int32_t width, height;
  int32_t projection, model;
  float cam_from_world[12];  // rows of [R | t]
  float near_radius;
  float low_pass;        // added to the footprint; erp, pinhole: px^2; tangent: rad^2; ray: has none
  int32_t wrap;          // 1: footprints continue across the +-180 degree seam
  int32_t square;        // 1: published bounds, a square of 3 sigma of the longest axis rounded out to tiles
  float fx, fy, cx, cy;  // pinhole
  float widen;           // rad^2, times r^2 added to the 3D covariance
  float off_panorama;    // of a table: largest angle in radians to the rays of a panorama; < 0: arbitrary rays
  int32_t compensate;    // 1: widening lowers the opacity
  int32_t cull_ellipsoids;  // 1: ray: the whole drawn Gaussian must be beyond near_radius, not only its mean
  float steepness;          // of the kernel of projective footprints; see padgs/render/contract.py
};

// One projected Gaussian as the blender reads it: a cache line.
struct alignas(16) Footprint {
  float shape[11];  // planar: u, v, a, b, c;  projective: l0 (3), l1 (3), m (3), kappa, near_ratio
  float log2_opacity;
  float depth;
  float red, green, blue;
};
static_assert(sizeof(Footprint) == 64, "padgs/render/backends/cpu.py allocates 16 floats per footprint");

// Pixels that a footprint can reach: rows [row, row_end), columns [column, column_end) and, beyond the seam,
// [0, second_end) with second_end <= column. Nothing where row == row_end.
struct PixelBox {
  int32_t column, column_end, second_end, row, row_end;
};
static_assert(sizeof(PixelBox) == 20, "padgs/render/backends/cpu.py allocates 5 integers per box");

// Tiles: rows of 16 pixels; in a row of level l a tile is 16 2^l pixels wide.
struct TileGrid {
  int32_t width, height;
  int32_t first_row, end_row;  // rows of tiles that are drawn
  const int32_t *level;        // [rows of tiles]
  const int64_t *row_start;    // [drawn rows + 1] tiles before each drawn row
};

// One (Gaussian, tile) pair, with the patches of the tile that the Gaussian can reach.
struct Instance {
  int32_t gaussian;
  uint32_t slot;                             // where its gradient sums go
  uint8_t row, row_end, column, column_end;  // of patches, from the tile's corner; ends are exclusive
};
static_assert(sizeof(Instance) == 12, "padgs/render/backends/cpu.py allocates 3 integers per instance");

struct Inputs {
  int64_t count;
  const float *means, *quats, *scales, *opacities, *colors;  // [N,3] [N,4] [N,3] [N] [N,3]
  const float *mean_offsets;                                         // [N,2] or null
};

struct Gradients {
  float *means, *quats, *scales, *opacities, *colors;  // as in Inputs, written not added to
  float *mean_offsets;                                        // [N,2] or null
  double *pose;                                        // [12] or null
};

// Directions of the pixels, for projective footprints. Rows are padded to whole tiles.
struct Rays {
  const float *column_sine, *column_cosine;  // [padded W] of the longitude   } a panorama
  const float *row_sine, *row_cosine;        // [H] of the latitude           }
  const float *table;                        // [H, 3, padded W], or null for a panorama
};

struct BlendArguments {
  TileGrid grid;
  int32_t projection, wrap;
  int32_t core_size;  // hybrid blending with this many sorted fragments; 0: sorted blending
  float steepness;    // as in Camera
  Rays rays;
  const Footprint *footprints;           // [N]
  const int64_t *tile_start;             // [tiles + 1] over the drawn tiles
  const Instance *instances;             // [I] tile by tile, front to back
  const float *background;               // [3]
  float *image, *transmittance, *depth;  // [H,W,3] [H,W] [H,W]
  int32_t *last;                         // [H,W] 1 + position in the tile's list of the last contribution; sorted only
  int64_t *pair_counts;                  // [tiles, 2] evaluated and contributing pairs
  // Hybrid: state kept for the backward pass (kept_cores.h); null without gradients.
  int32_t *cores;       // padgs_core_words(...) words, of which only the used ones are touched
  int64_t *core_start;  // [tiles + 1] where each tile's begin, and how many words are in use: 0 before forward
};

struct BlendGradientArguments {
  BlendArguments forward;
  const float *grad_image, *grad_transmittance, *grad_depth;  // [H,W,3] [H,W] or null, [H,W] or null
  float *gradient_sums;                                       // [I, kGradientSums] by slot
  float *grad_rays;                                           // [H, 3, padded W] or null
  int32_t absgrad;  // 1: also compute the absolute positional gradient, in sum kAbsgradSum; `ray` only
};

struct LeaveOneOutArguments {
  BlendArguments forward;
  const float *target, *weight;  // [H,W,3], and [H,W] of the squared error of each pixel
  float *removals;               // [I, kRemoval] by slot
};

// One network w2 relu(w1 x + b1) + b2; w1 [hidden, I], w2 [outputs, hidden].
struct HeadWeights {
  const float *w1, *b1, *w2, *b2;
};

// A anchors with K Gaussians each, N of the A K selected.
struct DecodeArguments {
  int64_t anchors;
  int32_t offsets, inputs, hidden;         // K, I, hidden units
  HeadWeights opacity, color, covariance;  // K, 3 K and 7 K outputs
  const float *input_rows;                 // [A, I]
  const float *positions, *offset_rows;    // [A, 3] [A, K, 3]
  const float *log_scales;                 // [A, 6]
  const float *attenuation;                // [A] 1 - tau Omega
  float *raw_opacities;                    // [A, K]
  int64_t *slot_start;                     // [A + 1]: where each anchor's selected Gaussians begin
  int64_t *slots;                          // [N] anchor K + k
  float *means, *quats, *scales, *opacities, *colors;  // [N, ...]
};

struct DecodeGradientArguments {
  DecodeArguments forward;
  const float *means, *quats, *scales, *opacities, *colors;  // upstream, [N, ...]
  int32_t features;                                          // number of leading inputs with a gradient
  float *features_out, *offsets_out, *log_scales_out;        // [A, features] [A, K, 3] [A, 6]
  float *weights_out;  // all of opacity, color, covariance: w1, b1, w2, b2 each
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

// Arguments of padgs.methods.plus.smoothness.roughness.
struct RoughnessArguments {
  int32_t width, height;
  int32_t wrap;                               // 1: the ends of rows are neighbours
  float nearest;                              // no distance is taken to be less
  float edges, jump;                          // EDGES and JUMP of the definition
  const float *image;                         // [H,W,3]
  const float *transmittance, *depth;         // [H,W]
  const float *row_weight;                    // [H]
  float *workspace;                           // padgs_roughness_workspace(H, W) floats, zero before the first call
  float *gradient;                            // [H,W], by depth, or null
};

// Parameters of explicit Gaussians to attributes for one view; with `grad_colors` the derivatives.
struct SplatArguments {
  int64_t count;
  int32_t degree;       // of the spherical harmonics that are in use, 0 to 3
  int32_t stored;       // coefficients of a row of `rest`, which may be more
  int32_t offset_width;  // 0: no offsets; 3; or 4, the last one for the absolute positional gradient
  float center[3], tiny;  // camera centre; lower limit of distances; world units
  const float *means, *log_scales, *opacity_logits, *dc;  // [N,3] [N,3] [N] [N,3]
  const float *rest;                                      // [N,stored,3]
  const float *offsets;                                     // [N,offset_width], in halves of the distance
  float *moved, *scales, *opacities, *colors, *absgrad;     // [N,3] [N,3] [N] [N,3] [N] or null
  const float *grad_moved, *grad_scales, *grad_opacities, *grad_colors, *grad_absgrad;  // as these, or null
  float *grad_means, *grad_log_scales, *grad_opacity_logits, *grad_dc, *grad_rest, *grad_offsets;
};

}  // namespace padgs
