// Coefficients of the depth along a pinhole camera's rays, and normals, of Gaussians: interface between the host code and
// the kernels of both devices. ../ray_blending/ray_blending.h defines the columns of `rays`.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

namespace gsplat::splat_rays {

struct Inputs {
  const float* means;    // [count, 3]
  const float* quats;    // [count, 4]
  const float* scales;   // [count, 3]
  const float* viewmat;  // [4, 4]
  const float* K;        // [3, 3]
  int64_t count;
};

struct Gradients {
  const float* v_rays;     // [count, 10]
  const float* v_normals;  // [count, 3]
  float* v_means;          // [count, 3]
  float* v_quats;          // [count, 4]
  float* v_scales;         // [count, 3]
};

// CPU kernels of the ray coefficients and their gradients, for rows `begin` to `end` - 1.
struct Kernels {
  void (*forward)(const Inputs& in, float* rays, float* normals, int64_t begin, int64_t end);
  void (*backward)(const Inputs& in, const Gradients& gradients, int64_t begin, int64_t end);
};

// Ray coefficients and normals of all splats, and their gradients, on CUDA; all pointers are device memory.
void forward_on_device(const Inputs& in, float* rays, float* normals, cudaStream_t stream);
void backward_on_device(const Inputs& in, const Gradients& gradients, cudaStream_t stream);

}  // namespace gsplat::splat_rays

GSPLAT_KERNELS(splat_rays, Kernels)
