// Interface through which device code requests scratch memory from the op, and helpers for launch sizes. Uses no torch
// headers.
#pragma once

#include <cstddef>
#include <cstdint>

// Allocates device memory that lasts until the end of the op.
class CudaScratch {
 public:
  virtual void* bytes(size_t count) = 0;
  template <class T>
  T* array(int64_t count) {
    return static_cast<T*>(bytes(size_t(count > 0 ? count : 1) * sizeof(T)));
  }

 protected:
  ~CudaScratch() = default;
};

constexpr int kThreads = 256;  // per block, for kernels with one item per thread

constexpr unsigned blocks_for(int64_t items, int64_t per_block = kThreads) {
  return unsigned((items + per_block - 1) / per_block);
}

// Return the number of bits needed to store 0 to n - 1; at least one.
constexpr int bits_below(int64_t n) {
  int bits = 1;
  while (bits < 63 && (int64_t(1) << bits) < n) ++bits;
  return bits;
}
