// Regression by Gaussian splats: f(x) = sum over splats of v g(x), g = |det A|^-1 N(A^-1 (x - b)), and its closed-form
// gradients.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::splat_regression {

constexpr int kMaxDims = 4;  // of a point

// A splat prepared for evaluation: y = whiten (x - centre), g = exp2(log2_norm - y.y log2(e) / 2). A splat with a singular
// or non-finite factor has log2_norm = -infinity, adds nothing and has no gradient.
struct Splat {
  float centre[kMaxDims];
  float whiten[kMaxDims * kMaxDims];  // A^-1, row-major [dims, dims]
  float log2_norm;
};

// Columns of the sums of a splat over all points: sum h, sum h y (dims), sum h y y^T (upper triangle, row by row), with
// h = g <dL/df, v>; then sum g dL/df (channels).
constexpr int kMaxMoments = 1 + kMaxDims + kMaxDims * (kMaxDims + 1) / 2;
constexpr int moments_of(int dims) { return 1 + dims + dims * (dims + 1) / 2; }

struct Inputs {
  const float* points;   // [count, dims]
  const float* centres;  // [splats, dims]
  const float* factors;  // [splats, dims, dims]
  const float* values;   // [splats, channels]
  int64_t count, splats;
  int32_t dims, channels;
};

struct Gradients {
  float* centres;
  float* factors;
  float* values;
};

// CPU: points and gradients with one row per dimension or channel, padded to a multiple of `stride` values.
struct Rows {
  const Splat* records;  // [splats]
  const float* points;   // [dims, stride]
  int64_t stride;        // a multiple of kRowPadding
};
constexpr int64_t kRowPadding = 16;

struct Kernels {
  // Prepares the splats [begin, end) for evaluation, in `records`.
  void (*records)(const Inputs& in, int64_t begin, int64_t end, Splat* records);
  // Writes f at the points [begin, end), multiples of kRowPadding, to `out` [channels, stride].
  void (*forward)(const Inputs& in, const Rows& rows, int64_t begin, int64_t end, float* out);
  // Computes the gradients of splats [begin, end) from dL/df, `gradient` [channels, stride]. `sums` holds 16 floats and one
  // double for each channel.
  void (*backward)(const Inputs& in, const Rows& rows, const float* gradient, int64_t begin, int64_t end, const Gradients& out,
                   float* lanes, double* sums);
};

// Splat regression on CUDA, forward and backward; all pointers are device memory.
void regress_on_device(const Inputs& in, float* out, CudaScratch& scratch, cudaStream_t stream);
void regress_backward_on_device(const Inputs& in, const float* gradient, const Gradients& out, CudaScratch& scratch,
                                cudaStream_t stream);

}  // namespace gsplat::splat_regression

GSPLAT_KERNELS(splat_regression, Kernels)
