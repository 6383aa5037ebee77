// Updates that strategies make in every training step: statistics of gradients, and noise on positions.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

namespace gsplat::densification {

// Screen gradients of one step, and the statistics that it is added to.
struct Statistics {
  const float* gradients;  // [images, count, 2]
  const int32_t* radii;    // [images, count, 2]; both above 0 where visible
  float scale_x, scale_y;  // factors of the gradients
  float extent_scale;      // factor of the radii
  float* sums;             // [count]: sum of gradient lengths
  float* counts;           // [count]: number of images that show the Gaussian
  float* largest;          // [count]: largest scaled radius, or null
  int64_t images, count;
};

// Gaussians whose positions receive noise.
struct Diffusion {
  float* means;             // [count, 3]
  const float* quats;       // [count, 4]
  const float* log_scales;  // [count, 3]
  const float* logits;      // [count]: opacities
  const float* noise;       // [count, 3]
  float scale, opacity_at_half, steepness;
};

// CPU kernels for Gaussians `begin` to `end` - 1.
struct Kernels {
  void (*accumulate)(const Statistics& s, int64_t begin, int64_t end);
  void (*diffuse)(const Diffusion& d, int64_t begin, int64_t end);
};

// `Kernels` on CUDA, for all Gaussians; all pointers are device memory.
void accumulate_on_device(const Statistics& s, cudaStream_t stream);
void diffuse_on_device(const Diffusion& d, int64_t count, cudaStream_t stream);

}  // namespace gsplat::densification

GSPLAT_KERNELS(densification, Kernels)
