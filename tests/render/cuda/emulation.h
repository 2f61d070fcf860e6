// CUDA on one CPU thread, as far as the kernels of padgs use it: the threads of a block take turns, each on a stack
// of its own, and give way where they wait for one another. A wait that hardware would not survive ends the process
// with a word: threads that wait at different barriers, lanes of a warp that wait for different things, or a full warp's
// exchange that some lane has left. Shared memory begins each block as bytes of ones: NaN, -1.
//
// With PADGS_EMULATION_SEED in the environment, who goes on is chosen at random, from that seed: between two barriers one
// warp may then be far ahead of another. Results that differ from seed to seed hide a race.
#pragma once

#include <link.h>
#include <setjmp.h>
#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <random>
#include <vector>

#define __global__ static
#define __device__
#define __host__
#define __shared__ static thread_local  // nothing else is, so that all of it lies side by side
#define __launch_bounds__(...)

struct Dim {
  unsigned x;
};
inline Dim threadIdx, blockIdx, blockDim, gridDim;
inline int current_device, last_error;  // of CUDA's, which nothing here runs on, but which code may choose and read

inline int cudaGetDevice(int *device) { return *device = current_device, 0; }
inline int cudaSetDevice(int device) { return current_device = device, 0; }
inline int cudaGetLastError() {
  const int error = last_error;
  return last_error = 0, error;
}

namespace emulation {

enum Wait { kNothing, kBlock, kWarp, kOver };

// Where in the source a thread waits.
struct Place {
  const char *file;
  int line;
  bool operator==(const Place &other) const { return line == other.line && !std::strcmp(file, other.file); }
};
#define PADGS_HERE const char *file = __builtin_FILE(), int line = __builtin_LINE()

struct Fiber {
  ucontext_t begin;
  jmp_buf at;
  bool begun;
  Wait wait;
  Place place;
  unsigned calls;  // exchanges so far; two of them may be in flight
  std::vector<char> stack;
};

constexpr int kStack = 64 << 10, kLanes = 32;
inline std::vector<Fiber> fibers;
inline std::vector<uint64_t> mailbox[2];
inline int running;
inline jmp_buf scheduler;
inline std::function<void()> body;

inline void complain(const char *what) {
  std::fprintf(stderr, "emulated block %u, thread %d: %s\n", blockIdx.x, running, what);
  std::abort();
}

inline void give_way(Wait wait, Place place) {
  Fiber &me = fibers[running];
  me.wait = wait, me.place = place;
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

__attribute__((noinline)) inline void prepare(Fiber &fiber) {  // getcontext would endanger variables of who inlines it
  fiber.begun = false, fiber.wait = kNothing, fiber.place = {"", 0}, fiber.calls = 0;
  getcontext(&fiber.begin);
  fiber.begin.uc_stack.ss_sp = fiber.stack.data();
  fiber.begin.uc_stack.ss_size = fiber.stack.size();
  fiber.begin.uc_link = nullptr;
  makecontext(&fiber.begin, enter, 0);
}

// Lets a warp go on if all its lanes wait for one another.
inline bool release_warp(int first, int end) {
  int waiting = 0, over = 0;
  bool agreed = true;
  for (int i = first; i < end; ++i) {
    waiting += fibers[i].wait == kWarp, over += fibers[i].wait == kOver;
    agreed &= fibers[i].place == fibers[first].place;
  }
  if (!waiting) return false;
  if (over) complain("a lane has left its warp");
  if (waiting != end - first || !agreed) complain("lanes of a warp wait for different things");
  for (int i = first; i < end; ++i) fibers[i].wait = kNothing;
  return true;
}

struct Memory {
  void *begin;
  size_t bytes;
};

// The shared memory of this library: its thread-local storage.
inline Memory shared_memory() {
  Memory found{};
  static thread_local char some;
  *static_cast<volatile char *>(&some) = 0;  // now there is memory for all of it
  dl_iterate_phdr(
      [](dl_phdr_info *module, size_t, void *found) {
        const auto *parts = module->dlpi_phdr, *end = parts + module->dlpi_phnum;
        const uintptr_t here = uintptr_t(&fibers) - module->dlpi_addr;
        const bool mine = std::any_of(parts, end, [&](const auto &part) {
          return part.p_type == PT_LOAD && part.p_vaddr <= here && here < part.p_vaddr + part.p_memsz;
        });
        for (; mine && parts != end; ++parts)
          if (parts->p_type == PT_TLS) *static_cast<Memory *>(found) = {module->dlpi_tls_data, parts->p_memsz};
        return int(mine);
      },
      &found);
  return found;
}

inline void run_block(int threads) {
  const char *seed = std::getenv("PADGS_EMULATION_SEED");
  std::minstd_rand random(seed ? unsigned(std::atoi(seed)) + blockIdx.x : 0);
  std::vector<int> order(threads);
  for (int i = 0; i < threads; ++i) {
    order[i] = i;
    prepare(fibers[i]);
  }
  const auto some_warps = [&] { return seed ? random() : 0; };
  const auto among = [](auto warps, int i) { return warps >> (i / kLanes % 16) & 1; };
  auto behind = some_warps();  // until all others wait for them
  for (;;) {
    bool moved = false;
    if (seed) std::shuffle(order.begin(), order.end(), random);
    const auto slow = some_warps();  // wait for another round
    for (const int i : order) {
      if (fibers[i].wait != kNothing || among(behind, i)) continue;
      moved = true;
      if (!among(slow, i)) resume(i);
    }
    for (int first = 0; first < threads; first += kLanes)
      moved |= release_warp(first, first + kLanes < threads ? first + kLanes : threads);
    if (moved) continue;
    if (behind) {
      behind = 0;
      continue;
    }
    behind = some_warps();
    const auto at_barrier = [](const Fiber &fiber) { return fiber.wait == kBlock; };
    const auto end = fibers.begin() + threads, first = std::find_if(fibers.begin(), end, at_barrier);
    if (first == end) return;  // all are over
    for (auto fiber = first; fiber != end; ++fiber) {
      if (!at_barrier(*fiber)) continue;
      if (!(fiber->place == first->place)) complain("threads of a block wait at different barriers");
      fiber->wait = kNothing;
    }
  }
}

// Everybody of a warp leaves a value and then reads those of all: [kLanes] from the first lane's on.
template <class T>
const uint64_t *exchange(T value, Place place) {
  static_assert(sizeof(T) <= sizeof(uint64_t), "");
  const int turn = int(fibers[running].calls++ & 1);
  uint64_t raw = 0;
  std::memcpy(&raw, &value, sizeof value);
  mailbox[turn][running] = raw;
  give_way(kWarp, place);
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
  blockDim.x = threads, gridDim.x = blocks;
  const Memory shared = shared_memory();
  for (unsigned block = 0; block < blocks; ++block) {
    blockIdx.x = block;
    std::memset(shared.begin, 0xff, shared.bytes);
    run_block(int(threads));
  }
}

inline void __syncthreads(PADGS_HERE) { emulation::give_way(emulation::kBlock, {file, line}); }
inline int __syncthreads_or(int value, PADGS_HERE) {
  static int result;
  if (value) result = 1;
  __syncthreads(file, line);
  const int total = result;
  __syncthreads(file, line);
  result = 0;
  __syncthreads(file, line);
  return total;
}
inline void __syncwarp(PADGS_HERE) { emulation::exchange(0, {file, line}); }

template <class T>
T __shfl_xor_sync(unsigned, T value, int mask, PADGS_HERE) {
  const uint64_t *all = emulation::exchange(value, {file, line});
  return emulation::from<T>(all, (emulation::running % 32) ^ mask);
}
inline unsigned __ballot_sync(unsigned, bool vote, PADGS_HERE) {
  const uint64_t *all = emulation::exchange(int(vote), {file, line});
  unsigned bits = 0;
  for (int lane = 0; lane < 32; ++lane) bits |= unsigned(emulation::from<int>(all, lane) != 0) << lane;
  return bits;
}
inline bool __any_sync(unsigned lanes, bool vote, PADGS_HERE) { return __ballot_sync(lanes, vote, file, line); }
inline int __ffs(unsigned bits) { return __builtin_ffs(int(bits)); }
inline int __popc(unsigned bits) { return __builtin_popcount(bits); }
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
