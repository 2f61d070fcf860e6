// CUDA on one CPU thread, as far as the kernels of padgs use it: the threads of a block take turns, each on a stack
// of its own, and give way where they wait for one another. A wait that hardware would not survive ends the process
// with a word: lanes of a warp that disagree on what they wait for, or a full warp's exchange that some lane has
// left. With PADGS_EMULATION_REVERSED in the environment the turns go backwards; results that change hide a race.
#pragma once

#include <setjmp.h>
#include <ucontext.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <vector>

#define __global__ static
#define __device__
#define __host__
#define __shared__ static
#define __launch_bounds__(...)

struct Dim {
  unsigned x;
};
inline Dim threadIdx, blockIdx, blockDim;
inline int current_device, last_error;  // of CUDA's, which nothing here runs on, but which code may choose and read

inline int cudaGetDevice(int *device) { return *device = current_device, 0; }
inline int cudaSetDevice(int device) { return current_device = device, 0; }
inline int cudaGetLastError() {
  const int error = last_error;
  return last_error = 0, error;
}

namespace emulation {

enum Wait { kNothing, kBlock, kWarp, kOver };

struct Fiber {
  ucontext_t begin;
  jmp_buf at;
  bool begun;
  Wait wait;
  unsigned calls;  // exchanges so far; two of them may be in flight
  std::vector<char> stack;
};

constexpr int kStack = 64 << 10, kLanes = 32;
inline std::vector<Fiber> fibers;
inline std::vector<uint64_t> mailbox[2];
inline int running, living, votes[2];
inline jmp_buf scheduler;
inline std::function<void()> body;

inline void complain(const char *what) {
  std::fprintf(stderr, "emulated block %u, thread %d: %s\n", blockIdx.x, running, what);
  std::abort();
}

inline void give_way(Wait wait) {
  Fiber &me = fibers[running];
  me.wait = wait;
  if (!_setjmp(me.at)) _longjmp(scheduler, 1);
}

inline void enter() {
  body();
  fibers[running].wait = kOver;
  _longjmp(scheduler, 1);
}

inline void resume(int index) {
  Fiber &fiber = fibers[index];
  running = index;
  threadIdx.x = unsigned(index);
  if (_setjmp(scheduler)) return;
  if (fiber.begun) _longjmp(fiber.at, 1);
  fiber.begun = true;
  setcontext(&fiber.begin);
}

// Lets a warp go on if all its lanes wait for one another.
inline bool release_warp(int first, int end) {
  int waiting = 0, over = 0;
  for (int i = first; i < end; ++i) waiting += fibers[i].wait == kWarp, over += fibers[i].wait == kOver;
  if (!waiting) return false;
  if (waiting != end - first) complain(over ? "a lane has left its warp" : "lanes of a warp wait for different things");
  for (int i = first; i < end; ++i) fibers[i].wait = kNothing;
  return true;
}

inline void run_block(int threads) {
  const bool reversed = std::getenv("PADGS_EMULATION_REVERSED");
  for (int i = 0; i < threads; ++i) {
    Fiber &fiber = fibers[i];
    fiber.begun = false, fiber.wait = kNothing, fiber.calls = 0;
    getcontext(&fiber.begin);
    fiber.begin.uc_stack.ss_sp = fiber.stack.data();
    fiber.begin.uc_stack.ss_size = fiber.stack.size();
    fiber.begin.uc_link = nullptr;
    makecontext(&fiber.begin, enter, 0);
  }
  for (;;) {
    bool moved = false;
    for (int k = 0; k < threads; ++k) {
      const int i = reversed ? threads - 1 - k : k;
      if (fibers[i].wait == kNothing) resume(i), moved = true;
    }
    for (int first = 0; first < threads; first += kLanes)
      moved |= release_warp(first, first + kLanes < threads ? first + kLanes : threads);
    if (moved) continue;
    living = 0;
    for (int i = 0; i < threads; ++i) living += fibers[i].wait == kBlock;
    if (!living) return;  // all are over
    for (int i = 0; i < threads; ++i)
      if (fibers[i].wait == kBlock) fibers[i].wait = kNothing;
  }
}

// Everybody of a warp leaves a value and then reads those of all: [kLanes] from the first lane's on.
template <class T>
const uint64_t *exchange(T value) {
  static_assert(sizeof(T) <= sizeof(uint64_t), "");
  const int turn = int(fibers[running].calls++ & 1);
  uint64_t raw = 0;
  std::memcpy(&raw, &value, sizeof value);
  mailbox[turn][running] = raw;
  give_way(kWarp);
  return mailbox[turn].data() + running / kLanes * kLanes;
}
template <class T>
T from(const uint64_t *values, int lane) {
  T value;
  std::memcpy(&value, values + lane, sizeof value);
  return value;
}

}  // namespace emulation

template <class F>
void emulate(unsigned blocks, unsigned threads, F kernel) {
  using namespace emulation;
  if (fibers.size() < threads) {
    fibers.resize(threads);
    for (Fiber &fiber : fibers) fiber.stack.resize(kStack);
    for (auto &box : mailbox) box.resize(threads + kLanes);
  }
  body = kernel;
  blockDim.x = threads;
  for (unsigned block = 0; block < blocks; ++block) {
    blockIdx.x = block;
    run_block(int(threads));
  }
}

inline void __syncthreads() { emulation::give_way(emulation::kBlock); }
inline int __syncthreads_or(int value) {
  static int result[2];
  int &mine = result[emulation::fibers[emulation::running].calls++ & 1];
  if (value) mine = 1;
  __syncthreads();
  const int total = mine;
  __syncthreads();
  mine = 0;
  __syncthreads();
  return total;
}
inline void __syncwarp() { emulation::exchange(0); }

template <class T>
T __shfl_xor_sync(unsigned, T value, int mask) {
  const uint64_t *all = emulation::exchange(value);
  return emulation::from<T>(all, (emulation::running % 32) ^ mask);
}
inline unsigned __ballot_sync(unsigned, bool vote) {
  const uint64_t *all = emulation::exchange(int(vote));
  unsigned bits = 0;
  for (int lane = 0; lane < 32; ++lane) bits |= unsigned(emulation::from<int>(all, lane) != 0) << lane;
  return bits;
}
inline bool __any_sync(unsigned lanes, bool vote) { return __ballot_sync(lanes, vote); }
inline int __ffs(unsigned bits) { return __builtin_ffs(int(bits)); }
inline int __clz(int bits) { return bits ? __builtin_clz(unsigned(bits)) : 32; }

template <class T>
T atomicAdd(T *at, T value) {
  const T before = *at;
  *at += value;
  return before;
}
inline int atomicMax(int *at, int value) {
  const int before = *at;
  if (value > before) *at = value;
  return before;
}
