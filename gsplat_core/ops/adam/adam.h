// Adam (Kingma and Ba 2015, algorithm 1) on one contiguous span.
#pragma once

#include <cstdint>

#include "isa.h"

struct AdamKernels {
  // `rate` has the bias corrections folded in: rate = lr / (1 - beta1^t), and `inv_bias2` = 1 / sqrt(1 - beta2^t).
  void (*step)(float* p, const float* g, float* m, float* v, int64_t n, float rate, float inv_bias2, float beta1, float beta2,
               float epsilon);
};
GSPLAT_DECLARE_KERNELS(AdamKernels, adam_kernels)
