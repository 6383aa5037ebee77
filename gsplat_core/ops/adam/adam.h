// Adam (Kingma and Ba 2015, algorithm 1) on whole rows of contiguous values.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

namespace gsplat::adam {

struct AdamStep {
  float rate;            // learning rate / (1 - beta1^t)
  float inv_bias2;       // 1 / sqrt(1 - beta2^t)
  float fresh1, fresh2;  // 1 - beta1, 1 - beta2, subtracted in double: 1 - 0.999f is off by 5e-5
  float epsilon;
  int64_t row_size;  // values per row; one non-finite gradient leaves the whole row unchanged
};

// AdamStep with learning rate and step in device memory.
struct AdamAt {
  const float* rate;            // [1]: the learning rate
  const int64_t* step;          // [1]: counts from 1
  double log_beta1, log_beta2;  // natural logarithms
  float fresh1, fresh2, epsilon;
  int64_t row_size;
};

// CPU kernels.
struct Kernels {
  // Updates parameters with gradients, first and second moments of `rows` rows; returns the number of rows skipped for
  // their gradients. Rows that are false in `shown` are left unchanged and not counted; null: all
  // rows are shown.
  int64_t (*step)(float* p, const float* g, float* m, float* v, const bool* shown, int64_t rows, const AdamStep& step);
};

// Adam steps on CUDA. All pointers are device memory; the number of skipped rows is added to `skipped`.
void adam_on_device(float* p, const float* g, float* m, float* v, const bool* shown, int64_t rows, const AdamStep& step,
                    int64_t* skipped, cudaStream_t stream);
void adam_at_on_device(float* p, const float* g, float* m, float* v, int64_t rows, const AdamAt& at, int64_t* skipped,
                       cudaStream_t stream);

}  // namespace gsplat::adam

GSPLAT_KERNELS(adam, Kernels)
