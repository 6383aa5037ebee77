// Covariance and precision matrices from rotations and scales.
#pragma once

#include <cstdint>

#include "isa.h"

struct CovarianceKernels {
  // R S^p S^p R^T with p = 1, or -1 when `inverse`; rows of 6 (upper triangle) or 9 floats.
  void (*forward)(const float* quats, const float* scales, float* out, bool inverse, bool triu, int64_t begin, int64_t end);
  // Either gradient may be null.
  void (*backward)(const float* quats, const float* scales, const float* v_covars, const float* v_precis, bool triu,
                   float* v_quats, float* v_scales, int64_t begin, int64_t end);
};
GSPLAT_DECLARE_KERNELS(CovarianceKernels, covariance_kernels)
