// Alpha compositing by the response of Gaussians along each pixel's ray (Wu et al. 2025), forward and backward: interface
// between the host code and the kernels of both devices.
#pragma once

#include <cstdint>

#include "../compositing/compositing.h"

namespace gsplat::world_blending {

constexpr int kMostLanes = 16;        // of a CPU vector
constexpr int kRayNumbers = 6;        // origin and unit direction
constexpr int kGaussianNumbers = 12;  // mean, and rows of the matrix that maps offsets to standard deviations
// Sums over the pixels of a Gaussian: alpha dL/dalpha, and dL/d(whitened offset of the ray's origin) (3 numbers) and
// dL/d(whitening matrix) (9 numbers). Gradients of the colours follow.
constexpr int kMoments = 13;
constexpr int kWindow = 16;        // pixels per side of the windows of a tile in the backward pass
constexpr int kMostChannels = 16;  // of one launch of the CUDA backward pass

struct Inputs {
  const float* gaussians;  // [batches, count, kGaussianNumbers]
  const float* colors;     // [images, count, channels]
  const float* opacities;  // [images, count]; 0 for splats that must not be shown
  const float* rays;       // [images, height, width, kRayNumbers]; NaN where the lens sees nothing
  const int32_t* offsets;  // [images, tile_height, tile_width]
  const int32_t* flatten_ids;
  const bool* masks;         // [images, tile_height, tile_width] or null
  int64_t count, instances;  // Gaussians of a batch, length of flatten_ids
  int32_t images, cameras, channels, width, height, tile_size, tile_width, tile_height;
  float max_alpha;

  constexpr int64_t windows() const {  // per tile
    const int64_t side = (tile_size + kWindow - 1) / kWindow;
    return side * side;
  }
};

struct Pixels {
  float* colors;   // [images, height, width, channels], without background
  float* through;  // transmittance [images, height, width]
  int32_t* last;   // [images, height, width]: position in flatten_ids of the last blended Gaussian, or -1
};

// Inputs of the backward pass: results of the forward pass, and gradients of the loss by both.
struct PixelGradients {
  const float* through;
  const int32_t* last;
  const float *v_colors, *v_through;
};

struct InputGradients {
  float* gaussians;  // [images, count, kGaussianNumbers]
  float* colors;     // [images, count, channels]
  float* opacities;  // [images, count]
  float* rays;       // [images, height, width, kRayNumbers]
};

// CPU: one row per instance (a Gaussian in a tile) with its sums, the moments and the gradients of the colours.
struct GradientRows {
  const int32_t* row_of;  // row of every position in flatten_ids
  float* rows;
  int64_t row_size;
  float* rays;  // as in InputGradients
};

struct Kernels {
  void (*tile)(const Inputs& in, int64_t tile, const Pixels& out, float* scratch);  // scratch: channels * kMostLanes
  // Adds the gradients of a tile's pixels to its rows. `scratch` has backward_scratch(channels) floats.
  void (*tile_backward)(const Inputs& in, int64_t tile, const PixelGradients& from, const GradientRows& out, float* scratch);
  // Sums the rows [first[i], first[i + 1]) of each Gaussian of an image and converts them to gradients, for [begin, end).
  void (*gather)(const Inputs& in, const GradientRows& from, const int32_t* first, int64_t begin, int64_t end,
                 const InputGradients& out);
};

// Floats per pixel of a window in the backward pass on the CPU: ray, its gradient, transmittance, and the sum of weight times
// dL/dweight of the Gaussians behind; then the gradients of the colours. A vector of sums per channel follows.
constexpr int kPixelNumbers = 2 * kRayNumbers + 2;
constexpr int64_t backward_scratch(int64_t channels) {
  return kWindow * kWindow * (kPixelNumbers + channels) + channels * kMostLanes;
}

// Blending of all pixels on CUDA, forward and backward; all pointers are device memory.
void blend_on_device(const Inputs& in, const Pixels& out, cudaStream_t stream);
void blend_backward_on_device(const Inputs& in, const PixelGradients& from, const InputGradients& out, CudaScratch& scratch,
                              cudaStream_t stream);

}  // namespace gsplat::world_blending

GSPLAT_KERNELS(world_blending, Kernels)
