// State that forward hybrid blending keeps for backward: the core of each pixel, and the sums over its tail.
//
// A record of 32-bit words for each patch of a tile, one after the other: tail sums, numbers of rows and entrants,
// positions of the entrants in the tile's list, rows from front to back. Alphas are cheaper to evaluate than to keep.
#pragma once

#include <algorithm>
#include <cstring>
#include <vector>

#include "fragments.h"
#include "tiles.h"

namespace padgs {
namespace PADGS_ISA {

constexpr int kTailWords = 6 * kLanes, kHeaderWords = kTailWords + 2;
static_assert(sizeof(Tail) == kTailWords * sizeof(float), "a tail is its sums");

// A row of the core (fragments.h) without its alphas: the entrant, and a bit for each pixel that has a fragment in it.
inline int32_t kept_row(int entrant, uint32_t lanes) { return int32_t(uint32_t(entrant) << kLanes | lanes); }
inline int entrant_of(int32_t row) { return int(uint32_t(row) >> kLanes); }
inline uint32_t lanes_bits_of(int32_t row) { return uint32_t(row) & ((1u << kLanes) - 1); }
static_assert(kLanes * kMaxCoreSize <= 1 << 16, "entrants are numbered by 16 bits; each has a row of its own");

// The most words that the records of the drawn tiles can need: every fragment in a core may be in a row of its own, and
// no instance is in more rows than a patch has pixels.
inline int64_t core_words(const BlendArguments &args) {
  int64_t words = 0;
  for (int row = args.grid.first_row; row < args.grid.end_row; ++row) {
    const int64_t *start = args.grid.row_start + (row - args.grid.first_row);
    for (int64_t index = start[0]; index < start[1]; ++index) {
      const Tile tile = tile_at(args, row, index);
      const int64_t instances = tile.end - tile.first, most = int64_t(kLanes) * args.core_size;
      words += tile.patches() * (kHeaderWords + std::min(most, instances) + std::min(most, kLanes * instances));
    }
  }
  return words;
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
    positions[entrants + k] = kept_row(numbers[row.entrant], bits(less(zero(), row.alpha)));
  }
  words.resize(start + kHeaderWords + entrants + rows);
}

// One record.
struct KeptPatch {
  Tail tail;
  int rows, entrants;
  const int32_t *positions;  // of the entrants, ascending
  const int32_t *row;        // from front to back; see kept_row

  // Reads the record at `words`, and moves on to the next.
  explicit KeptPatch(const int32_t *&words) {
    std::memcpy(static_cast<void *>(&tail), words, sizeof tail);
    rows = words[kTailWords], entrants = words[kTailWords + 1];
    positions = words + kHeaderWords;
    row = positions + entrants;
    words = row + rows;
  }
};

}  // namespace PADGS_ISA
}  // namespace padgs
