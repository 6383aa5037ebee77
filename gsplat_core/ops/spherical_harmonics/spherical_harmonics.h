// Sums of real spherical harmonics up to degree 4 (Sloan 2013, "Efficient Spherical Harmonic Evaluation").
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

namespace gsplat::spherical_harmonics {

constexpr int kMaxBases = 25;

// Directions [N, 3] (of any non-zero length) and coefficients [N, K, 3], of which the first (degree + 1)^2 are used.
struct SphericalHarmonicsInput {
  const float* dirs;
  const float* coeffs;
  const bool* mask;  // [N] or null; the sum and the gradients are 0 where false
  int degree;
  int64_t bases;  // K
};

// CPU kernels of the colours and their gradients, for directions `begin` to `end` - 1 of one row.
struct Kernels {
  void (*forward)(const SphericalHarmonicsInput&, float* colors, int64_t begin, int64_t end);
  // Computes the gradients of directions and coefficients. `v_dirs` [N, 3] may be null. `v_coeffs` [N, K, 3] is added
  // to if `accumulate`, otherwise overwritten completely.
  void (*backward)(const SphericalHarmonicsInput&, const float* v_colors, float* v_dirs, float* v_coeffs, bool accumulate,
                   int64_t begin, int64_t end);
};

// Colours from spherical harmonics on CUDA, for `rows` rows of `sets` directions; the rows share the coefficients of
// their sets. All pointers are device memory.
void harmonics_forward(const SphericalHarmonicsInput& in, int64_t rows, int64_t sets, float* colors, cudaStream_t stream);
// Compute the gradients of directions and coefficients. `v_dirs` may be null. `v_coeffs` is overwritten completely with
// the sum over the rows in order.
void harmonics_backward(const SphericalHarmonicsInput& in, int64_t rows, int64_t sets, const float* v_colors, float* v_dirs,
                        float* v_coeffs, cudaStream_t stream);

}  // namespace gsplat::spherical_harmonics

GSPLAT_KERNELS(spherical_harmonics, Kernels)
