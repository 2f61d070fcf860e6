// csrc/cuda/mma.cuh at work on whole matrices, whose numbers go to the lanes as the PTX manual says in its words about
// "matrix fragments for mma.m16n8k16 with floating point type": by the number i of each, not as the kernels do it.
#include "mma.cuh"

using namespace padgs;

namespace {

template <class T>
__global__ void product(const float *a, const float *b, float *out) {
  const int group = lane_index() >> 2, thread = lane_index() % 4;
  float of_a[8], of_b[4];
  for (int i = 0; i < 8; ++i) {
    const int row = i < 2 || (i >= 4 && i < 6) ? group : group + 8;
    const int column = thread * 2 + (i & 1) + (i >= 4 ? 8 : 0);
    of_a[i] = a[16 * row + column];
  }
  for (int i = 0; i < 4; ++i) of_b[i] = b[8 * (thread * 2 + (i & 1) + (i >= 2 ? 8 : 0)) + group];
  FragmentA left;
  for (int i = 0; i < 4; ++i) left.pairs[i] = packed(of_a[2 * i], of_a[2 * i + 1], T{});
  const FragmentB right{{packed(of_b[0], of_b[1], T{}), packed(of_b[2], of_b[3], T{})}};
  const auto place = [&](int i) { return 8 * (i < 2 ? group : group + 8) + thread * 2 + (i & 1); };
  Sums sums;
  for (int i = 0; i < 4; ++i) sums.of[i] = out[place(i)];
  multiply_add(sums, left, right, T{});
  for (int i = 0; i < 4; ++i) out[place(i)] = sums.of[i];
}

// A^T B for A [16, 16] and B [16, 16] of which a lane has the rows that sums would have.
__global__ void transposed_product(const float *a, const float *b, float *out) {
  const int group = lane_index() / 4, thread = lane_index() % 4;
  Sums rows[2][2], result[2] = {};
  const auto place = [&](int half, int i) { return 16 * (group + i / 2 * 8) + 8 * half + 2 * thread + i % 2; };
  for (int half = 0; half < 2; ++half)
    for (int i = 0; i < 4; ++i) rows[0][half].of[i] = a[place(half, i)], rows[1][half].of[i] = b[place(half, i)];
  const FragmentA left = transposed(as_factor<Bfloat16>(rows[0][0], rows[0][1]));
  const FragmentA right = transposed(as_factor<Bfloat16>(rows[1][0], rows[1][1]));
  for (int half = 0; half < 2; ++half) {
    multiply_add(result[half], left, columns_of(right, half), Bfloat16{});
    for (int i = 0; i < 4; ++i) out[place(half, i)] = result[half].of[i];
  }
}

template <class T>
__global__ void rounded(const float *numbers, float *out) {
  const int i = 2 * int(global_thread());
  const float2 pair = unpacked(packed(numbers[i], numbers[i + 1], T{}), T{});
  out[i] = pair.x, out[i + 1] = pair.y;
}

}  // namespace

extern "C" {
void check_product(int type, const float *a, const float *b, float *out) {
  launch(type ? product<Float16> : product<Bfloat16>, 1, kWarp, Queue{0, nullptr}, a, b, out);
}
void check_transposed_product(const float *a, const float *b, float *out) {
  launch(transposed_product, 1, kWarp, Queue{0, nullptr}, a, b, out);
}
void check_rounding(int type, int blocks, const float *numbers, float *out) {
  launch(type ? rounded<Float16> : rounded<Bfloat16>, blocks, kWarp, Queue{0, nullptr}, numbers, out);
}
}
