// The C ABI of libpadgs_cuda, beside the structures that it shares with the CPU library. Every pointer is to memory
// of the device, allocated by the caller, in Python. Every function returns a cudaError_t, 0 where all is well.
#pragma once

#include "core.h"
#include "layout.h"

namespace padgs {

struct ProjectArguments {
  Camera camera;      // its pose is not used
  const float *pose;  // [12] or more, rows of [R | t]
  Inputs in;
  Footprint *footprints;     // [N]
  PixelBox *boxes;           // [N]
  uint32_t *depth_keys;      // [N] bits of the depth, all ones where nothing is drawn
  int32_t *indices;          // [N] 0, 1, 2, ...
  TileTable table;           // of all rows
  unsigned long long *counts;  // [rows + 1] instances in each row of tiles, and Gaussians that are drawn; zero before
};

struct ProjectGradientArguments {
  Camera camera;
  const float *pose;
  Inputs in;
  const float *gradient_sums;  // [N, kGradientSums], sums over the instances of each Gaussian
  Gradients out;         // pose: [blocks, 12] partial sums, see padgs_cuda_pose_blocks, or null
};

struct SortArguments {
  void *scratch;  // padgs_cuda_scratch_bytes(count)
  int64_t scratch_bytes, count;
  uint32_t *keys, *sorted_keys;      // [count]
  int32_t *values, *sorted_values;
  int32_t bits;  // of the keys that differ
};

// Instances are numbered in depth order of their Gaussians: this number is their slot.
struct BinArguments {
  TileTable table;
  const PixelBox *boxes;
  const int32_t *order;  // [visible] front to back
  int64_t visible;       // or more: others that are in `order` touch no tile
  uint32_t *tiles;       // [visible + 1] how many tiles each touches, and 0
  uint32_t *slot_start;  // [visible + 1]
  Reach *reaches;        // [I] by slot
  // Of the I instances by tile; its values become the slots of the lists. Where I is room for more than there are, the
  // keys behind the last are those from before the call: at least the number of tiles.
  SortArguments sort;
  int32_t *tile_start;   // [tiles + 1]
};

struct BlendInputs {
  TileTable table;
  int32_t projection, wrap;
  int32_t core_size;  // hybrid blending with this many sorted fragments; 0: sorted blending
  float steepness;    // as in Camera
  Rays rays;
  const Footprint *footprints;
  const int32_t *tile_start, *slots;  // the lists: slots of each tile, front to back
  const Reach *reaches;
  const float *background;               // [3]
  float *image, *transmittance, *depth;  // [H,W,3] [H,W] [H,W]
  int32_t *last;                         // [H,W] 1 + position in the tile's list of the last contribution; sorted only
  int32_t *core;  // [H,W,core_size] sorted Gaussians, -1 behind the last; hybrid with gradients, or null
  Tail *tails;    // [H,W] as core
  int32_t *pair_counts;                  // [tiles, 2] evaluated and contributing pairs, or null
};

// Aligned, so that the GPU moves sixteen bytes at a time.
struct alignas(16) GradientSums {
  float of[kGradientSums];
};

struct BlendGradientInputs {
  BlendInputs forward;
  const float *grad_image, *grad_transmittance, *grad_depth;  // [H,W,3] [H,W] or null, [H,W] or null
  CoreGradient *core_gradients;  // [H,W,core_size]; hybrid only
  GradientSums *gradient_sums;        // [I] by slot
  float *grad_rays;        // [H, 3, padded W] or null
  const int32_t *order;    // [visible]
  const uint32_t *slot_start;
  int64_t visible;
  float *totals;  // [N, kGradientSums], added to
  int32_t absgrad;  // as in BlendGradientArguments
};

// After forward; sorted blending only. The instances are those of `forward`.
struct RemovalInputs {
  BlendInputs forward;
  const float *target, *weight;  // [H,W,3], and [H,W] of the squared error of each pixel
  float *removals;               // [I, kRemoval] by slot
};

// Without networks: their outputs are here. `slots` and the Gaussians' tensors have `room` rows.
struct DeviceDecodeArguments {
  DecodeArguments decode;
  int64_t room;
  const float *color_logits, *covariance_logits;  // [A, 3 K] [A, 7 K]
};
struct DeviceDecodeGradientArguments {
  DecodeGradientArguments gradient;                 // features_out and weights_out are not used
  int64_t room;                                     // there is no gradient of Gaussians behind it
  float *opacity_out, *color_out, *covariance_out;  // [A, K] [A, 3 K] [A, 7 K] dL by the networks' outputs
};

struct DeviceSplatArguments {
  SplatArguments splats;  // its center is not used
  const float *center;    // [3]
};

// The loss over all pixels is the sum of block_sums / total. Its workspace holds dL by three window means,
// [3, H, W, 3].
struct DeviceLossArguments {
  LossArguments loss;   // its normalizer is not used
  const float *total;   // [1]
  float *block_sums;    // [padgs_cuda_loss_blocks]
};

}  // namespace padgs
