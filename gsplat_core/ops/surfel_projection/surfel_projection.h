// Projection of surfels (flat Gaussians; Huang et al. 2024) to the images of pinhole cameras, forward and backward:
// interface between the host code and the kernels of both devices.
#pragma once

#include <cstdint>

#include "constants.h"
#include "cuda_stream.h"
#include "isa.h"

namespace gsplat::surfel_projection {

constexpr float kLeastExtentSquared = 1e-4f;  // px^2, of the bounding box at one standard deviation
constexpr int kMatrixSums = 12;               // gradient of a viewmat: rotation row by row, then translation

struct Size {
  int64_t batches, cameras, surfels;  // B, C, N
};

// Surfels and cameras in torch's row-major layout. A CPU kernel receives one batch and camera, a CUDA kernel all of
// them.
struct Inputs {
  const float* means;           // [B, N, 3]
  const float* quats;           // [B, N, 4]
  const float* scales;          // [B, N, 3]; the third is not used
  const float* viewmat;         // [B, C, 4, 4]
  const float* intrinsics;      // [B, C, 3, 3]
  float width, height;          // px
  float near_plane, far_plane;  // z
  float radius_clip;            // px
};

struct Outputs {
  int32_t* radii;         // [B, C, N, 2]
  float* means2d;         // [B, C, N, 2]
  float* depths;          // [B, C, N]
  float* ray_transforms;  // [B, C, N, 3, 3]
  float* normals;         // [B, C, N, 3]
};

// Gradients of the outputs; null where there is none.
struct OutputGradients {
  const int32_t* radii;  // (0, 0) marks culled surfels
  const float *means2d, *depths, *ray_transforms, *normals;
};

struct InputGradients {
  float *means, *quats, *scales;
  float* viewmat;   // kMatrixSums sums per block of surfels, or null
  bool accumulate;  // CPU: add to the gradients of the surfels
};

struct Kernels {
  void (*forward)(const Inputs& in, const Outputs& out, int64_t begin, int64_t end);
  void (*backward)(const Inputs& in, const OutputGradients& from, const InputGradients& to, int64_t begin, int64_t end);
};

// Return the inputs of one camera.
GSPLAT_HOST_DEVICE Inputs of_camera(Inputs in, const Size& size, int64_t batch, int64_t camera) {
  const int64_t row = batch * size.surfels, image = batch * size.cameras + camera;
  in.means += 3 * row;
  in.quats += 4 * row;
  in.scales += 3 * row;
  in.viewmat += 16 * image;
  in.intrinsics += 9 * image;
  return in;
}

// Projection of surfels on CUDA; all pointers are device memory. `to.viewmat` has room for `camera_sums` blocks.
int64_t camera_sums(const Size& size);
void project_on_device(const Inputs& in, const Size& size, const Outputs& out, cudaStream_t stream);
void project_backward_on_device(const Inputs& in, const Size& size, const OutputGradients& from, const InputGradients& to,
                                float* v_viewmats, cudaStream_t stream);

}  // namespace gsplat::surfel_projection

GSPLAT_KERNELS(surfel_projection, Kernels)
