// Backward blending looks at a few instances before it sums their gradients: evaluating needs no jumps and waits for
// nothing, and by then it is known which patches an instance draws in, which could not be predicted.
#pragma once

#include "tiles.h"

namespace padgs {
namespace PADGS_ISA {

constexpr int kEntrants = 8, kHits = 12;
constexpr int kMostPatches = (kTile << kMaxLevel) / kPatchWidth * (kTile / kPatchHeight);  // of a tile

// An instance that has been looked at.
struct Entrant {
  int32_t gaussian;
  uint32_t slot;
  int end;  // of its hits; they begin where those of the last one end
};

}  // namespace PADGS_ISA
}  // namespace padgs
