// Conversion between rows of K floats (torch's layout) and one vector per column.
#pragma once

#include "simd.h"

namespace GSPLAT_ISA {

// Load rows `first` to `first + count - 1`, one per lane. Lanes beyond `count` repeat the last row, so that they hold
// ordinary numbers.
template <int K>
GSPLAT_INLINE void load_rows(const float* p, int64_t first, int count, vfloat* columns) {
  p += first * K;
  if (K == 1 && count == kLanes) {
    columns[0] = load(p);
    return;
  }
  float transposed[K][kLanes];
  for (int i = 0; i < kLanes; ++i) {
    const float* row = p + int64_t(i < count ? i : count - 1) * K;
    for (int k = 0; k < K; ++k) transposed[k][i] = row[k];
  }
  for (int k = 0; k < K; ++k) columns[k] = load(transposed[k]);
}

template <int K>
GSPLAT_INLINE void store_rows(float* p, int64_t first, int count, const vfloat* columns) {
  p += first * K;
  if (K == 1 && count == kLanes) {
    store(p, columns[0]);
    return;
  }
  float transposed[K][kLanes];
  for (int k = 0; k < K; ++k) store(transposed[k], columns[k]);
  for (int i = 0; i < count; ++i)
    for (int k = 0; k < K; ++k) p[i * K + k] = transposed[k][i];
}

// Store one row per lane like store_rows, but add to the memory contents.
template <int K>
GSPLAT_INLINE void add_rows(float* p, int64_t first, int count, const vfloat* columns) {
  p += first * K;
  float transposed[K][kLanes];
  for (int k = 0; k < K; ++k) store(transposed[k], columns[k]);
  for (int i = 0; i < count; ++i)
    for (int k = 0; k < K; ++k) p[i * K + k] += transposed[k][i];
}

}  // namespace GSPLAT_ISA
