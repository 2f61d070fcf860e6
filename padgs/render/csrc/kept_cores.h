// What forward hybrid blending leaves to backward: who is in the core of each pixel, and the sums over its tail.
//
// A record of 32-bit words for each patch of a tile, one after the other: tail sums, numbers of rows and entrants,
// positions of the entrants in the tile's list, rows from front to back. Alphas are cheaper to evaluate than to keep.
#pragma once

#include <cstring>
#include <vector>

#include "fragments.h"

namespace padgs {
namespace PADGS_ISA {

// A row of the core (fragments.h) without its alphas.
struct KeptRow {
  uint16_t entrant;
  uint16_t lanes;  // a bit for each pixel that has a fragment in it
};
constexpr int kTailWords = 6 * kLanes, kHeaderWords = kTailWords + 2;
static_assert(sizeof(Tail) == kTailWords * sizeof(float), "a tail is its sums");
static_assert(kLanes * kMaxCoreSize <= 1 << 16, "entrants are numbered by 16 bits; each has a row of its own");

// The most that the records of an image can need: as if every fragment in the core of a pixel were of another instance.
inline int64_t core_words(const TileGrid &grid, int core_size) {
  const int64_t columns = (grid.width + kPatchWidth - 1) / kPatchWidth;
  const int64_t rows = int64_t(grid.end_row - grid.first_row) * (kTile / kPatchHeight);
  return columns * rows * (kHeaderWords + 2 * kLanes * int64_t(core_size));
}

// Adds the record of a patch. Entrants that others have pushed out of all cores are not in it.
inline void keep_patch(const Fragments &fragments, std::vector<int32_t> &words) {
  static thread_local std::vector<int32_t> numbers;  // of the entrants in the record, or -1
  numbers.assign(fragments.entrant_count, -1);
  for (int k = 1; k < fragments.row_count; ++k) numbers[fragments.rows[k].entrant] = 0;
  const size_t start = words.size();
  const int rows = fragments.row_count - 1;
  words.resize(start + kHeaderWords + fragments.entrant_count + rows);
  int32_t *const header = words.data() + start, *const positions = header + kHeaderWords;
  int entrants = 0;
  for (int e = 0; e < fragments.entrant_count; ++e) {
    if (numbers[e] < 0) continue;
    numbers[e] = entrants;
    positions[entrants++] = fragments.entrants[e];
  }
  std::memcpy(header, &fragments.tail, sizeof(Tail));
  header[kTailWords] = rows, header[kTailWords + 1] = entrants;
  for (int k = 0; k < rows; ++k) {
    const Row &row = fragments.rows[k + 1];
    const KeptRow kept = {uint16_t(numbers[row.entrant]), uint16_t(bits(less(zero(), row.alpha)))};
    std::memcpy(positions + entrants + k, &kept, sizeof kept);
  }
  words.resize(start + kHeaderWords + entrants + rows);
}

// One record.
struct KeptPatch {
  Tail tail;
  int rows, entrants;
  const int32_t *positions;  // of the entrants, ascending
  const KeptRow *row;        // from front to back

  // Reads the record at `words`, and moves on to the next.
  explicit KeptPatch(const int32_t *&words) {
    std::memcpy(static_cast<void *>(&tail), words, sizeof tail);
    rows = words[kTailWords], entrants = words[kTailWords + 1];
    positions = words + kHeaderWords;
    row = reinterpret_cast<const KeptRow *>(positions + entrants);
    words = positions + entrants + rows;
  }
};

}  // namespace PADGS_ISA
}  // namespace padgs
