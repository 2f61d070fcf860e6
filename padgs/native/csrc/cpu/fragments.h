// The fragments of sixteen pixels for hybrid blending: the nearest few in order, and sums over all others.
//
// The core is a list of rows, each of one instance: those of its fragments that are in the core of their pixels, with
// holes at the other pixels. A hole is a transparent fragment as far away as the one in front of it, so the distances
// of every pixel ascend along the rows. As instances come nearly front to back, most rows are appended; fragments
// that are nearer than others of their pixel make rows further up.
#pragma once

#include <algorithm>
#include <memory>
#include <utility>

#include "../abi.h"
#include "simd.h"

namespace padgs {
namespace PADGS_ISA {

struct Row {
  Vec distance, alpha;  // alpha 0: a hole
  int32_t entrant;
  int32_t front;  // the row in front of this one
};

// Sums over the fragments outside the core; independent of order up to rounding.
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

class Fragments {
 public:
  Tail tail;
  Vec reached, entered;         // fragments of each pixel: all, those in its rows
  Row *rows = nullptr;          // from 1 on; row 0 is in front of all, and empty
  int32_t *entrants = nullptr;  // positions in the tile's list, ascending
  int row_count, entrant_count;
  int last;       // of the rows, from front to back
  bool in_order;  // the rows lie as they follow each other

  void clear() {
    tail = Tail();
    reached = entered = zero();
    row_count = 1, entrant_count = last = 0, in_order = true;
    rows = row_storage_.get();
    reserve(0);
    rows[0] = {splat(-1.0f), zero(), 0, 0};
  }
  // Makes room for `more` instances: a row for each pixel of each at most, and one that is always written.
  void reserve(int more) {
    const int offset = int(rows - row_storage_.get());
    grow(row_storage_, row_capacity_, offset + row_count, kLanes * more + 1);
    rows = row_storage_.get() + offset;
    grow(entrant_storage_, entrant_capacity_, entrant_count, more + 1);
    entrants = entrant_storage_.get();
  }

  // Brings the rows into order: 1 is the nearest. Only the `core_size` nearest fragments of each pixel stay in them;
  // the others join the tail, and rows that have none left are dropped.
  template <class FootprintOf>
  void close(int core_size, FootprintOf footprint_of) {
    if (in_order) return;  // and none is too many: sorted fragments do not enter a full core
    in_order = true;
    grow(spare_storage_, spare_capacity_, 0, row_count);
    const Vec size = splat(float(core_size));
    Vec place = entered;  // of each pixel's next fragment, counted from the front
    Row *next = spare_storage_.get() + row_count;
    for (int k = last; k > 0; k = rows[k].front) {
      const Row &row = rows[k];
      const Mask filled = less(zero(), row.alpha), beyond = both(filled, less(size, place));
      place = place - keep(filled, splat(1.0f));
      Vec alpha = row.alpha;
      if (any(beyond)) {
        tail.add(keep(beyond, alpha), footprint_of(row));
        alpha = select(beyond, zero(), alpha);
        if (!any(less(zero(), alpha))) continue;
      }
      --next;
      next->distance = row.distance, next->alpha = alpha, next->entrant = row.entrant;
    }
    *--next = rows[0];
    std::swap(row_storage_, spare_storage_), std::swap(row_capacity_, spare_capacity_);
    row_count = int(row_storage_.get() + row_count - next);
    rows = next;
    for (int k = 1; k < row_count; ++k) rows[k].front = k - 1;
    last = row_count - 1;
    entered = minimum(entered, size);
  }

 private:
  template <class T>
  static void grow(std::unique_ptr<T[]> &storage, int &capacity, int used, int more) {
    if (used + more <= capacity) return;
    std::unique_ptr<T[]> larger(new T[std::max(used + more, 2 * capacity)]);
    std::copy_n(storage.get(), std::min(used, capacity), larger.get());
    storage.swap(larger);
    capacity = std::max(used + more, 2 * capacity);
  }
  std::unique_ptr<Row[]> row_storage_, spare_storage_;
  std::unique_ptr<int32_t[]> entrant_storage_;
  int row_capacity_ = 0, spare_capacity_ = 0, entrant_capacity_ = 0;
};

// Makes rows of fragments in pixels `moving`, each in front of all that are further away; all are nearer than the last
// row. Equal distances stay in the order of arrival. Returns the number of rows.
PADGS_INLINE int insert(Row *rows, int count, int last, Mask moving, Vec distance, Vec alpha, int32_t entrant) {
  int behind = last;
  for (;;) {
    const int front = rows[behind].front;
    const Vec nearest = rows[front].distance;
    const Mask further = both(moving, less(distance, nearest)), here = without(moving, further);
    // Always written, which is cheaper than a branch.
    rows[count] = {select(here, distance, nearest), keep(here, alpha), entrant, front};
    const int added = any(here);
    rows[behind].front = front + (count - front) * added;
    count += added;
    if (!any(further)) return count;
    moving = further;
    behind = front;
  }
}

}  // namespace PADGS_ISA
}  // namespace padgs
