#include "adam.h"
#include "simd.h"

namespace GSPLAT_ISA::adam {

using gsplat::adam::AdamStep;

constexpr int64_t kBlock = 2048;  // values per block; checked and updated while in the L1 cache

// Return true if every squared gradient is finite: an infinite second moment would freeze its parameter.
static bool usable(const float* g, int64_t n) {
  vfloat nan_if_unusable{};
  int64_t i = 0;
  for (; i + kLanes <= n; i += kLanes) {
    const vfloat x = load(g + i);
    nan_if_unusable += x * x * 0.0f;
  }
  float rest = 0;
  for (; i < n; ++i) rest += g[i] * g[i] * 0.0f;
  return bits(nan_if_unusable == 0) == bits(vfloat{} == 0) && rest == 0;
}

static void update(float* __restrict__ p, const float* __restrict__ g, float* __restrict__ m, float* __restrict__ v, int64_t n,
                   const AdamStep& step) {
  const float rate = step.rate, inv_bias2 = step.inv_bias2, epsilon = step.epsilon;
  const float fresh1 = step.fresh1, fresh2 = step.fresh2;
  for (int64_t i = 0; i < n; ++i) {
    const float gi = g[i];
    const float mi = m[i] + fresh1 * (gi - m[i]);
    const float vi = v[i] + fresh2 * (gi * gi - v[i]);
    m[i] = mi;
    v[i] = vi;
    p[i] -= rate * mi / (__builtin_sqrtf(vi) * inv_bias2 + epsilon);
  }
}

static int64_t step_rows(float* p, const float* g, float* m, float* v, int64_t rows, const AdamStep& step) {
  const int64_t size = step.row_size, block = size < kBlock ? kBlock / size : 1;
  int64_t skipped = 0;
  for (int64_t row = 0; row < rows; row += block) {
    const int64_t count = rows - row < block ? rows - row : block, at = row * size;
    if (usable(g + at, count * size)) {
      update(p + at, g + at, m + at, v + at, count * size, step);
      continue;
    }
    for (int64_t r = row; r < row + count; ++r) {
      if (usable(g + r * size, size))
        update(p + r * size, g + r * size, m + r * size, v + r * size, size, step);
      else
        ++skipped;
    }
  }
  return skipped;
}

static int64_t step(float* p, const float* g, float* m, float* v, const bool* shown, int64_t rows, const AdamStep& step) {
  if (shown == nullptr) return step_rows(p, g, m, v, rows, step);
  int64_t skipped = 0;
  for (int64_t row = 0; row < rows;) {
    int64_t end = row;
    while (end < rows && shown[end]) ++end;
    const int64_t at = row * step.row_size;
    skipped += step_rows(p + at, g + at, m + at, v + at, end - row, step);
    row = end + 1;  // row `end` is not shown, or past the last
  }
  return skipped;
}

extern const gsplat::adam::Kernels kernels = {step};

}  // namespace GSPLAT_ISA::adam
