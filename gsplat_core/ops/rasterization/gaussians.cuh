// One Gaussian of a batch and the coefficients of a warp's 32 Gaussians, for the forward and the backward kernel.
#pragma once

#include "../projection/projection_math.h"
#include "../spherical_harmonics/spherical_harmonics_bases.h"
#include "rasterization.h"

namespace gsplat::rasterization {
namespace {

using namespace GSPLAT_ISA::projection;
using namespace GSPLAT_ISA::spherical_harmonics;

constexpr unsigned kWholeWarp = 0xffffffffu;

// The inputs of projection for one batch and one camera.
__device__ inline ProjectionInput seen_by(const Scene& scene, int64_t batch, int64_t image) {
  ProjectionInput in = scene.projection;
  in.compensation_floor = kCompensationFloor;  // so that the compiler knows it
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

__device__ inline Geometry load_geometry(const ProjectionInput& in, int64_t n) {
  if (in.covars != nullptr) {
    Symmetric3 sigma;
    for (int k = 0; k < 6; ++k) sigma.v[k] = in.covars[6 * n + k];
    return geometry_of(sigma);
  }
  float quat[4], scales[3];
  for (int k = 0; k < 4; ++k) quat[k] = in.quats[4 * n + k];
  for (int k = 0; k < 3; ++k) scales[k] = in.scales[3 * n + k];
  return geometry_of(quat, scales);
}

// Where the camera is: the first three numbers of the last column of the inverse of its matrix, by Cramer's rule, as
// `camera_centers` in view_colors.py has it.
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

// By all threads of a block, for one image; ends with a barrier.
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

// The unit vector from the camera to the Gaussian; returns one over their distance.
__device__ inline float unit_direction(const float* center, const float* mean, float (&direction)[3]) {
  float squared = 0;
  for (int k = 0; k < 3; ++k) {
    direction[k] = mean[k] - center[k];
    squared = fmaf(direction[k], direction[k], squared);
  }
  const float inverse = 1.0f / ::sqrtf(squared);
  for (int k = 0; k < 3; ++k) direction[k] *= inverse;
  return inverse;
}

template <int degree>
constexpr int kBasesOf = (degree + 1) * (degree + 1);

template <int bytes>
__device__ inline void start_copy(void* to, const void* from) {
  const unsigned at = unsigned(__cvta_generic_to_shared(to));
  if constexpr (bytes == 16) {
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(at), "l"(from) : "memory");
  } else {
    asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" ::"r"(at), "l"(from) : "memory");
  }
}

// The coefficients of 32 Gaussians that a degree uses, in shared memory. A lane's row is an odd number of float4s from the next:
// then eight lanes that read the same float4 of theirs meet in no bank. Rows in global memory may be longer than the degree
// needs.
template <int degree>
struct Coefficients {
  static constexpr int kUsed = 3 * kBasesOf<degree>, kQuads = (kUsed + 3) / 4, kStride = 4 * (kQuads | 1);
  alignas(16) float values[32 * kStride];

  __device__ float* row(int lane) { return values + lane * kStride; }

  // Starts reading the rows that `wanted` has a bit for, by the whole warp; they are there after `wait`.
  __device__ void load(const float* from, int row_floats, unsigned wanted, int lane) {
    if (row_floats % 4 == 0 && reinterpret_cast<uintptr_t>(from) % 16 == 0) {
#pragma unroll 4
      for (int i = lane; i < 32 * kQuads; i += 32) {
        const int set = i / kQuads, quad = i % kQuads;
        if (wanted >> set & 1) start_copy<16>(values + set * kStride + 4 * quad, from + int64_t(set) * row_floats + 4 * quad);
      }
    } else {
#pragma unroll 4
      for (int i = lane; i < 32 * kUsed; i += 32) {
        const int set = i / kUsed, place = i % kUsed;
        if (wanted >> set & 1) start_copy<4>(values + set * kStride + place, from + int64_t(set) * row_floats + place);
      }
    }
  }
  __device__ static void wait() {
    asm volatile("cp.async.wait_all;" ::: "memory");
    __syncwarp();
  }

  // Writes `rows` rows, with zeros for coefficients that the degree does not use. Call it after a __syncwarp.
  __device__ void store(float* to, int row_floats, int rows, int lane) const {
    if (row_floats % 4 == 0 && reinterpret_cast<uintptr_t>(to) % 16 == 0) {
      const int quads = row_floats / 4;
      for (int i = lane; i < rows * quads; i += 32) {
        const int set = i / quads, quad = i % quads;
        float4 q = make_float4(0, 0, 0, 0);
        if (quad < kQuads) {
          q = *reinterpret_cast<const float4*>(values + set * kStride + 4 * quad);
          if (4 * quad + 1 >= kUsed) q.y = 0;
          if (4 * quad + 2 >= kUsed) q.z = 0;
          if (4 * quad + 3 >= kUsed) q.w = 0;
        }
        reinterpret_cast<float4*>(to)[i] = q;
      }
    } else {
      for (int i = lane; i < rows * row_floats; i += 32) {
        const int set = i / row_floats, place = i % row_floats;
        to[i] = place < kUsed ? values[set * kStride + place] : 0;
      }
    }
  }
};

// run(std::integral_constant) for a degree of 0 to 4 or kPlainColors; the host has checked it.
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
