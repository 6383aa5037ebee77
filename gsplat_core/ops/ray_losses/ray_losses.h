// Losses of the surface rendered along rays, and their gradients: difference of inverse depths, and consistency of normals.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::ray_losses {

constexpr float kLargestJump = 0.02f;  // LARGEST_JUMP in gsplat_core/rendering/surface.py
constexpr double kLeastInverse = 1e-12;
constexpr int kPinhole = 0, kOrtho = 1, kFisheye = 2;  // CAMERA_MODELS in Python

// Sum of |1/depth - 1/known| over tissue of known depth, divided by the sum of 1/known.
struct DepthLoss {
  const float* depths;    // [height, width]
  const float* known;     // [height, width], 0 where unknown
  const uint8_t* tissue;  // [height, width], 0 or 1
  int32_t height, width;
  float* v_depths;  // [height, width], output
};

// Mean of alpha - (blended normal . normal of the depths) over tissue on which the depths have a normal.
struct NormalLoss {
  const float* depths;    // [height, width]
  const float* alphas;    // [height, width]
  const float* normals;   // [height, width, 3], sums of weight times normal
  const uint8_t* tissue;  // [height, width], 0 or 1
  const float* K;         // [3, 3]
  int32_t height, width, camera_model;
  // Scratch, for a term of each pixel: derivatives [height, width, 4] by slope and mean of the depth along x, then along y,
  // and bits [height, width] kCompared, kWideX, kWideY.
  float* changes;
  uint8_t* bits;
  float *v_depths, *v_alphas, *v_normals;  // outputs
};
// The pixel is compared; its differences along x or y are also taken at 2 px.
constexpr uint8_t kCompared = 1, kWideX = 2, kWideY = 4;

// Sums over pixels of a loss: terms, and what they are divided by.
struct Sums {
  double terms, divisor;
};

// CPU kernels. The first pass of a loss writes the sums of rows [begin, end), and the derivatives of the terms of normals.
// The second pass writes the gradients times `scale`.
struct Kernels {
  void (*depth_terms)(const DepthLoss& loss, Sums* rows, int64_t begin, int64_t end);
  void (*depth_gradients)(const DepthLoss& loss, float scale, int64_t begin, int64_t end);
  void (*normal_terms)(const NormalLoss& loss, Sums* rows, int64_t begin, int64_t end);
  void (*normal_gradients)(const NormalLoss& loss, float scale, int64_t begin, int64_t end);
};

// The losses on CUDA; all pointers are device memory. `value` [1] receives the loss.
void depth_loss_on_device(const DepthLoss& loss, float* value, CudaScratch& scratch, cudaStream_t stream);
void normal_loss_on_device(const NormalLoss& loss, float* value, CudaScratch& scratch, cudaStream_t stream);

}  // namespace gsplat::ray_losses

GSPLAT_KERNELS(ray_losses, Kernels)
