// Sums of real spherical harmonics up to degree 4 (Sloan 2013, "Efficient Spherical Harmonic Evaluation").
#pragma once

#include <cstdint>

#include "isa.h"

constexpr int kMaxBases = 25;

// Directions [N, 3] (of any length but zero), coefficients [N, K, 3] of which the first (degree + 1)^2 are used.
struct SphericalHarmonicsInput {
  const float* dirs;
  const float* coeffs;
  const bool* mask;  // [N] or null; where false the sum and the gradients are 0
  int degree;
  int64_t bases;  // K
};

struct SphericalHarmonicsKernels {
  void (*forward)(const SphericalHarmonicsInput&, float* colors, int64_t begin, int64_t end);
  // `v_dirs` [N, 3] may be null; `v_coeffs` [N, K, 3] is added to when `accumulate`, else written whole.
  void (*backward)(const SphericalHarmonicsInput&, const float* v_colors, float* v_dirs, float* v_coeffs, bool accumulate,
                   int64_t begin, int64_t end);
};
GSPLAT_DECLARE_KERNELS(SphericalHarmonicsKernels, spherical_harmonics_kernels)
