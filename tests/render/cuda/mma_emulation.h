// Tensor cores for csrc/cuda/mma.cuh on the CPU: lanes exchange their fragments, and each adds up its own four sums. What
// is multiplied lies where the fragments of PTX's mma.m16n8k16 have it, and is of the type that it is packed as.
#pragma once

struct float2 {
  float x, y;
};

namespace padgs {

// The nearest number of `bits` significant bits, of two the even one; multiples of 2^smallest.
inline float nearest(float x, int bits, int smallest) {
  if (x == 0 || !std::isfinite(x)) return x;
  int exponent;
  std::frexp(x, &exponent);
  const int unit = std::max(exponent - bits, smallest);
  return float(std::ldexp(std::nearbyint(std::ldexp(double(x), -unit)), unit));
}

inline uint16_t bits_of(float x, Bfloat16) {
  const float rounded = nearest(x, 8, -133);
  uint32_t bits;
  std::memcpy(&bits, &rounded, sizeof bits);
  return uint16_t(std::isnan(x) ? 0x7fff : bits >> 16);
}
inline float value_of(uint16_t bits, Bfloat16) {
  const uint32_t wide = uint32_t(bits) << 16;
  float x;
  std::memcpy(&x, &wide, sizeof x);
  return x;
}

inline uint16_t bits_of(float x, Float16) {
  const float magnitude = std::fabs(nearest(x, 11, -24));
  const uint16_t sign = std::signbit(x) ? 0x8000 : 0;
  if (std::isnan(x)) return 0x7fff;
  if (magnitude > 65504) return uint16_t(sign | 0x7c00);
  if (magnitude < std::ldexp(1.0f, -14)) return uint16_t(sign | int(std::ldexp(magnitude, 24)));
  int exponent;
  const float mantissa = std::frexp(magnitude, &exponent);  // in [1/2, 1)
  return uint16_t(sign | ((exponent + 14) << 10 | (int(std::ldexp(mantissa, 11)) & 0x3ff)));
}
inline float value_of(uint16_t bits, Float16) {
  const int exponent = bits >> 10 & 31, mantissa = bits & 0x3ff;
  const float magnitude = exponent == 31 ? (mantissa ? NAN : INFINITY)
                          : exponent     ? std::ldexp(float(mantissa | 0x400), exponent - 25)
                                         : std::ldexp(float(mantissa), -24);
  return bits & 0x8000 ? -magnitude : magnitude;
}

template <class T>
uint32_t packed(float low, float high, T type) {
  return bits_of(low, type) | uint32_t(bits_of(high, type)) << 16;
}
template <class T>
float2 unpacked(uint32_t pair, T type) {
  return {value_of(uint16_t(pair), type), value_of(uint16_t(pair >> 16), type)};
}

// Number `k` of those that the lanes' pairs have in a row.
template <class T>
float number(uint32_t pair, int k, T type) {
  return value_of(uint16_t(pair >> 16 * (k % 2)), type);
}

template <class T>
void multiply_add(Sums &sums, const FragmentA &a, const FragmentB &b, T type, PADGS_HERE) {
  const auto joined = [](const uint32_t *pairs) { return pairs[0] | uint64_t(pairs[1]) << 32; };
  const int group = emulation::running % kWarp / 4, thread = emulation::running % 4;
  float rows[2][16], columns[2][16];  // of A and of B, as far as this lane's sums need them
  for (int half = 0; half < 2; ++half) {
    const uint64_t *all = emulation::exchange(joined(a.pairs + 2 * half), {file, line});
    for (int k = 0; k < 8; ++k) {
      const uint64_t both = all[4 * group + k / 2];
      rows[0][8 * half + k] = number(uint32_t(both), k, type);
      rows[1][8 * half + k] = number(uint32_t(both >> 32), k, type);
    }
  }
  const uint64_t *all = emulation::exchange(joined(b.pairs), {file, line});
  for (int n = 0; n < 2; ++n) {
    for (int k = 0; k < 16; ++k) {
      const uint64_t both = all[4 * (2 * thread + n) + k % 8 / 2];
      columns[n][k] = number(uint32_t(k < 8 ? both : both >> 32), k, type);
    }
  }
  for (int i = 0; i < 4; ++i) {
    double sum = sums.of[i];
    for (int k = 0; k < 16; ++k) sum += double(rows[i / 2][k]) * double(columns[i % 2][k]);
    sums.of[i] = float(sum);
  }
}

inline uint32_t transposed(uint32_t pair, PADGS_HERE) {
  const uint64_t *all = emulation::exchange(pair, {file, line});
  const int group = emulation::running % kWarp / 4, thread = emulation::running % 4;
  uint32_t result = 0;
  for (int j = 0; j < 2; ++j) {
    const uint32_t from = uint32_t(all[4 * (2 * thread + j) + group / 2]);
    result |= (from >> 16 * (group % 2) & 0xffff) << 16 * j;
  }
  return result;
}

}  // namespace padgs
