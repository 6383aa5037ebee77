// Inputs of one Gaussian and its camera, for the forward and the backward kernels.
#pragma once

#include "../projection/projection_device.cuh"
#include "../spherical_harmonics/staged_harmonics.cuh"
#include "rasterization.h"

namespace gsplat::rasterization {
namespace {

using namespace projection;
using namespace spherical_harmonics;

constexpr unsigned kWholeWarp = 0xffffffffu;

// Return the inputs of projection for one batch and one camera.
__device__ inline ProjectionInput seen_by(const Scene& scene, int64_t batch, int64_t image) {
  ProjectionInput in = scene.projection;
  in.compensation_floor = kCompensationFloor;  // makes the value known to the compiler
  const int64_t row = batch * scene.gaussians;
  in.means += 3 * row;
  if (in.covars != nullptr) {
    in.covars += 6 * row;
  } else {
    in.quats += 4 * row;
    in.scales += 3 * row;
  }
  in.opacities += row;
  in.viewmat += 16 * image;
  in.intrinsics += 9 * image;
  return in;
}

// Compute the camera centre: the translation of the inverse view matrix, by Cramer's rule. `camera_centers` in
// rendering/pipeline.py uses the same formula.
__device__ inline void center_of(const float* m, float* center) {
  float crosses[3][3];
  for (int row = 0; row < 3; ++row) {
    const float *a = m + 4 * ((row + 1) % 3), *b = m + 4 * ((row + 2) % 3);
    crosses[row][0] = a[1] * b[2] - a[2] * b[1];
    crosses[row][1] = a[2] * b[0] - a[0] * b[2];
    crosses[row][2] = a[0] * b[1] - a[1] * b[0];
  }
  float determinant = 0, last = 0;
  for (int k = 0; k < 3; ++k) {
    center[k] = -(m[3] * crosses[0][k] + m[7] * crosses[1][k] + m[11] * crosses[2][k]);
    determinant += m[k] * crosses[0][k];
    last += m[12 + k] * center[k];
  }
  for (int k = 0; k < 3; ++k) center[k] /= last + m[15] * determinant;
}

// Load the camera centre of one image. All threads of a block must call it. Ends with a barrier.
__device__ inline void load_center(const Scene& scene, int64_t image, float (&center)[3]) {
  if (threadIdx.x == 0) {
    if (scene.centers != nullptr) {
      for (int k = 0; k < 3; ++k) center[k] = scene.centers[3 * image + k];
    } else {
      center_of(scene.projection.viewmat + 16 * image, center);
    }
  }
  __syncthreads();
}

// Call run(std::integral_constant) with the degree as a compile-time constant: 0 to 4, or kPlainColors. The host has
// checked it.
template <class Run>
void with_degree(int degree, const Run& run) {
  switch (degree) {
    case 0: return run(std::integral_constant<int, 0>());
    case 1: return run(std::integral_constant<int, 1>());
    case 2: return run(std::integral_constant<int, 2>());
    case 3: return run(std::integral_constant<int, 3>());
    case 4: return run(std::integral_constant<int, 4>());
    default: return run(std::integral_constant<int, kPlainColors>());
  }
}

}  // namespace
}  // namespace gsplat::rasterization
