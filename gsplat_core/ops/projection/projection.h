// Projection of 3D Gaussians to screen-space ellipses (EWA splatting, Zwicker et al. 2001), forward and backward:
// interface between the host code and the kernels of both devices.
#pragma once

#include <cstdint>

#include "constants.h"
#include "cuda_stream.h"
#include "isa.h"

namespace gsplat::projection {

enum CameraModel : int32_t { kPinhole = 0, kOrtho = 1, kFisheye = 2 };

struct ProjectionSize {
  int64_t batches, cameras, gaussians;  // B, C, N
};

// Gaussians and cameras in torch's row-major layout. A CPU kernel receives one batch and camera, a CUDA kernel all of
// them.
struct ProjectionInput {
  const float* means;           // [B, N, 3]
  const float* covars;          // [B, N, 6]; null if quats and scales are given
  const float* quats;           // [B, N, 4]
  const float* scales;          // [B, N, 3]
  const float* opacities;       // [B, N] or null
  const float* viewmat;         // [B, C, 4, 4]
  const float* intrinsics;      // [B, C, 3, 3]
  float width, height;          // px
  float eps2d;                  // px^2, added to the diagonal of the 2D covariance
  float near_plane, far_plane;  // z
  float radius_clip;            // px
  CameraModel model;
  float compensation_floor = kCompensationFloor;
};

struct ProjectionOutput {
  int32_t* radii;        // [B, C, N, 2]
  float* means2d;        // [B, C, N, 2]
  float* depths;         // [B, C, N]
  float* conics;         // [B, C, N, 3]
  float* compensations;  // [B, C, N] or null
};

// Gradients of the outputs; null where there is none.
struct ProjectionOutputGradient {
  const int32_t* radii;  // (0, 0) marks culled Gaussians
  const float* means2d;
  const float* depths;
  const float* conics;
  const float* compensations;
};

struct ProjectionInputGradient {
  float* means;
  float* covars;  // null if quats and scales are given
  float* quats;
  float* scales;
  float* viewmat;  // 12 sums per block of Gaussians, or null: rotation row by row, then translation
  // CPU: add to means, covars, quats and scales instead of overwriting them, for all cameras but the first
  bool accumulate;
};

// Return the inputs of one camera.
GSPLAT_HOST_DEVICE ProjectionInput of_camera(ProjectionInput in, const ProjectionSize& size, int64_t batch, int64_t camera) {
  const int64_t row = batch * size.gaussians, image = batch * size.cameras + camera;
  in.means += 3 * row;
  if (in.covars != nullptr) in.covars += 6 * row;
  if (in.quats != nullptr) in.quats += 4 * row;
  if (in.scales != nullptr) in.scales += 3 * row;
  if (in.opacities != nullptr) in.opacities += row;
  in.viewmat += 16 * image;
  in.intrinsics += 9 * image;
  return in;
}

// CPU kernels for Gaussians `begin` to `end` - 1 of one camera.
struct Kernels {
  void (*forward)(const ProjectionInput&, const ProjectionOutput&, int64_t begin, int64_t end);
  void (*backward)(const ProjectionInput&, const ProjectionOutputGradient&, const ProjectionInputGradient&, int64_t begin,
                   int64_t end);
};

// Projection of all Gaussians to all cameras on CUDA; all pointers are device memory.
void project_on_device(const ProjectionInput& in, const ProjectionSize& size, const ProjectionOutput& out, cudaStream_t stream);
// `to.viewmat` is null or has memory for 12 sums of each of camera_sums(size) blocks. The sums are added to
// `v_viewmats` [B, C, 4, 4], which must be zeroed. Sums over Gaussians and cameras are taken in a fixed order.
void project_backward_on_device(const ProjectionInput& in, const ProjectionSize& size, const ProjectionOutputGradient& from,
                                const ProjectionInputGradient& to, float* v_viewmats, cudaStream_t stream);
int64_t camera_sums(const ProjectionSize& size);

}  // namespace gsplat::projection

GSPLAT_KERNELS(projection, Kernels)
