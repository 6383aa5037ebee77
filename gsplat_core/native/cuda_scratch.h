// What device code needs of the op that calls it, without torch's headers: scratch memory, and the size of a launch.
#pragma once

#include <cstddef>
#include <cstdint>

// Device memory that lasts until the end of the op.
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

constexpr int kThreads = 256;  // of a block, where a thread does one item

constexpr unsigned blocks_for(int64_t items, int64_t per_block = kThreads) {
  return unsigned((items + per_block - 1) / per_block);
}

// The bits that hold the numbers 0 to n - 1, one at least.
constexpr int bits_below(int64_t n) {
  int bits = 1;
  while (bits < 63 && (int64_t(1) << bits) < n) ++bits;
  return bits;
}
