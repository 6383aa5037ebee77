// Histograms of the depth that a range sensor measures, one per column of the picture, forward and backward: interface
// between the host code and the kernels of both devices.
//
// A splat with weight w in a pixel adds w (cdf((edge[b + 1] - t) / s) - cdf((edge[b] - t) / s)) to bin b of the pixel's column,
// where t is its depth along the ray and s the standard deviation of its density there (../ray_blending).
#pragma once

#include <cstdint>

#include "../ray_blending/ray_blending.h"

namespace gsplat::range_histogram {

using ray_blending::kRayNumbers;

constexpr int kGradients = 6 + kRayNumbers;  // means2d (2), conics (3), opacity, rays
constexpr int64_t kMaxBins = 65536;
constexpr float kReachSigmas = 4.5f;                   // a bin further from a splat's depth receives nothing
constexpr double kQuantum = 1.0 / (int64_t(1) << 36);  // of the sums of weights on CUDA, which are independent of their order

struct Inputs {
  ray_blending::Inputs splats;  // without values
  const float* factors;         // [height, width] or null: factor of t and s; 0 for pixels that the sensor does not see
  float nearest, bin;           // depth of the first edge, and width of a bin
  int32_t bins;
};

struct InputGradients {
  float* means2d;    // [count, 2]
  float* conics;     // [count, 3]
  float* opacities;  // [count]
  float* rays;       // [count, kRayNumbers]
};

struct Kernels {
  // Adds the tile column's pixels to the histograms `out` [width, bins].
  void (*columns)(const Inputs& in, int64_t tile_column, double* scratch, float* out);
  // Writes the gradients of a tile's list entries to `rows` [instances, kGradients], from the gradient [width, bins].
  void (*tile_backward)(const Inputs& in, const float* gradient, int64_t tile, float* rows);
};

// Range histogram on CUDA, forward and backward; all pointers are device memory.
void histogram_on_device(const Inputs& in, float* out, CudaScratch& scratch, cudaStream_t stream);
void histogram_backward_on_device(const Inputs& in, const float* gradient, const InputGradients& out, CudaScratch& scratch,
                                  cudaStream_t stream);

}  // namespace gsplat::range_histogram

GSPLAT_KERNELS(range_histogram, Kernels)
