// Adam (Kingma and Ba 2015, algorithm 1) on whole rows of contiguous values.
#pragma once

#include <cstdint>

#include "isa.h"

struct AdamStep {
  float rate;            // learning rate / (1 - beta1^t)
  float inv_bias2;       // 1 / sqrt(1 - beta2^t)
  float fresh1, fresh2;  // 1 - beta1, 1 - beta2, subtracted in double: 1 - 0.999f is off by 5e-5
  float epsilon;
  int64_t row_size;  // values that share their fate: one that is not finite keeps the whole row as it is
};

struct AdamKernels {
  // Parameter, gradient, first and second moment of `rows` rows; returns how many rows were left alone.
  int64_t (*step)(float* p, const float* g, float* m, float* v, int64_t rows, const AdamStep& step);
};
GSPLAT_DECLARE_KERNELS(AdamKernels, adam_kernels)
