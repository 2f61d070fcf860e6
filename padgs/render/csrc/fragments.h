// The fragments of sixteen pixels for hybrid blending: the nearest few in order, and sums over all others.
//
// The core is a list of rows. Each instance that enters the core of any of the pixels appends a row, with holes at the other
// pixels: transparent fragments as far away as what is in front of them. So the distances of every pixel ascend along the
// rows, and as instances come nearly front to back, few fragments have to be moved to an earlier row.
#pragma once

#include <algorithm>
#include <memory>
#include <vector>

#include "abi.h"
#include "simd.h"

namespace padgs {
namespace PADGS_ISA {

constexpr int32_t kMixed = -1;

struct Row {
  Vec distance, alpha;  // alpha 0: a hole
  int32_t entrant;      // of all its fragments; kMixed: they are in `entrants`
  VecI entrants;

  VecI each_entrant() const { return entrant == kMixed ? entrants : splat_int(entrant); }
};

struct Colors {
  Vec red, green, blue, depth;
};

// Sums over the fragments outside the core; they do not depend on any order but that of rounding.
struct Tail {
  Vec alpha = zero(), left = splat(1.0f);                           // sum of alpha, product of 1 - alpha
  Vec red = zero(), green = zero(), blue = zero(), depth = zero();  // sums of alpha times them

  template <class C>
  void add(Vec a, const C &c) {
    alpha += a;
    left = left - left * a;
    red += a * c.red;
    green += a * c.green;
    blue += a * c.blue;
    depth += a * c.depth;
  }
};

struct Fragments {
  Tail tail;
  Vec reached = zero(), entered = zero();  // fragments of each pixel: all, those in its rows
  Vec last = splat(-1.0f);                 // distance in the last row
  Row *rows = nullptr;
  int32_t *entrants = nullptr;  // positions in the tile's list, ascending
  int row_count = 0, entrant_count = 0;

  void clear() {
    tail = Tail();
    reached = entered = zero();
    last = splat(-1.0f);
    row_count = entrant_count = 0;
  }
  // Makes room for another `instances` of them.
  void reserve(int instances) {
    grow(row_storage_, rows, row_count, row_capacity_, row_count + instances + 1);
    grow(entrant_storage_, entrants, entrant_count, entrant_capacity_, entrant_count + instances + 1);
  }
  // Leaves the nearest `core_size` fragments of each pixel in the rows, and no empty rows; the others join the tail.
  template <class ColorsOf>
  void close(int core_size, ColorsOf colors_of) {
    const Vec size = splat(float(core_size));
    if (!any(less(size, entered))) return;
    Vec passed = zero();
    int kept = 0;
    for (int k = 0; k < row_count; ++k) {
      Row &row = rows[k];
      const Mask filled = less(zero(), row.alpha);
      passed += keep(filled, splat(1.0f));
      const Mask beyond = both(filled, less(size, passed));
      if (any(beyond)) {
        tail.add(keep(beyond, row.alpha), colors_of(row));
        row.alpha = select(beyond, zero(), row.alpha);
      }
      if (any(less(zero(), row.alpha))) {
        if (kept < k) rows[kept] = row;
        ++kept;
      }
    }
    row_count = kept;
    entered = minimum(entered, size);
  }

 private:
  template <class T>
  static void grow(std::unique_ptr<T[]> &storage, T *&data, int used, int &capacity, int needed) {
    if (needed <= capacity) return;
    std::unique_ptr<T[]> larger(new T[2 * needed]);
    std::copy_n(data, used, larger.get());
    storage.swap(larger);
    data = storage.get();
    capacity = 2 * needed;
  }
  std::unique_ptr<Row[]> row_storage_;
  std::unique_ptr<int32_t[]> entrant_storage_;
  int row_capacity_ = 0, entrant_capacity_ = 0;
};

// Moves fragments of row `last`, in pixels `moving`, in front of all that are further away. Equal distances stay in the
// order of arrival.
inline void move_forward(Row *rows, int last, Mask moving, Vec distance, Vec alpha) {
  const VecI entrant = splat_int(rows[last].entrant);
  for (int k = last;; --k) {
    Row &here = rows[k];
    const Row &front = rows[k > 0 ? k - 1 : 0];
    const Mask further = k > 0 ? both(moving, less(distance, front.distance)) : without(moving, moving);
    here.distance = select(further, front.distance, select(moving, distance, here.distance));
    here.alpha = select(further, front.alpha, select(moving, alpha, here.alpha));
    here.entrants = select_int(further, front.each_entrant(), select_int(moving, entrant, here.each_entrant()));
    here.entrant = kMixed;
    if (!any(further)) break;
    moving = further;
  }
}

}  // namespace PADGS_ISA
}  // namespace padgs
