// Alpha compositing by the response of Gaussians along each pixel's ray (Wu et al. 2025), forward: interface between the host
// code and the kernels of both devices.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

namespace gsplat::world_blending {

constexpr int kMostLanes = 16;        // of a CPU vector
constexpr int kRayNumbers = 6;        // origin and unit direction
constexpr int kGaussianNumbers = 12;  // mean, and rows of the matrix that maps offsets to standard deviations

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
};

struct Pixels {
  float* colors;   // [images, height, width, channels], without background
  float* through;  // transmittance [images, height, width]
};

struct Kernels {
  void (*tile)(const Inputs& in, int64_t tile, const Pixels& out, float* scratch);  // scratch: channels * kMostLanes
};

// CUDA version for all pixels, in device memory.
void blend_on_device(const Inputs& in, const Pixels& out, cudaStream_t stream);

}  // namespace gsplat::world_blending

GSPLAT_KERNELS(world_blending, Kernels)
