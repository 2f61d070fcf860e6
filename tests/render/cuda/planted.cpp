// Faulty kernels, for tests of the emulation: it has to find each of them out.
#include "device.cuh"

using namespace padgs;

namespace {

// Sums shared memory that nobody wrote to.
void unwritten(float *out) {
  __shared__ float room[64];
  if (threadIdx.x % 2) room[threadIdx.x] = 1;
  __syncthreads();
  out[threadIdx.x] = room[threadIdx.x] + room[threadIdx.x ^ 1];
}

// Looks at both neighbours without waiting for them: in ascending and in descending turns exactly one has been there.
void race(float *out) {
  __shared__ int there[64];
  const int i = int(threadIdx.x);
  there[i] = 0;
  __syncthreads();
  there[i] = 1;
  out[i] = float(i == 0 || i == 63 ? 1 : there[i - 1] + there[i + 1]);
}

// The second warp does not wait for the first, but is kept so long that it seems to.
void ahead(float *out) {
  __shared__ float room[64];
  const int i = int(threadIdx.x);
  room[i] = 0;
  __syncthreads();
  if (i < kWarp)
    room[i] = 1;
  else
    for (int k = 0; k < 1000; ++k) __syncwarp();
  out[i] = room[i % kWarp];
}

// The warps of a block wait at a barrier each.
void two_barriers(float *out) {
  if (threadIdx.x < kWarp)
    __syncthreads();
  else
    __syncthreads();
  out[threadIdx.x] = 1;
}

// Half a warp asks at one place, the other half at another.
void two_votes(float *out) {
  out[threadIdx.x] = 1.0f + (threadIdx.x % 2 ? __any_sync(kAllLanes, true) :
                             __any_sync(kAllLanes, false));
}

// Leaves to the compiler whether a product is rounded before the difference.
__attribute__((noinline)) float product(float x, float y) { return x * y; }
void contraction(float *out) {
  const float x = 1.0f + float(threadIdx.x) / 4099, rounded = product(x, x);
  out[threadIdx.x] = x * x - rounded;
}

}  // namespace

extern "C" void plant(int fault, float *out) {
  void (*const faults[])(float *) = {unwritten, race, ahead, two_barriers, two_votes, contraction};
  launch(faults[fault], 1, 64, Queue{0, nullptr}, out);
}
