// The gradient of a frame on CUDA: what the op's host code asks of the kernels. All pointers are to device memory.
#pragma once

#include "frame_cuda.h"

constexpr int kRateCount = 5;  // means, quats, log-scales, logit opacities, spherical harmonics

// What comes back from the picture, and what it is compared with on the way: the forward pass's transmittance and last splats.
struct FrameGradients {
  const float* v_image;   // [H, W, 4]: red, green, blue, sum of w z
  const float* v_alphas;  // [H, W], or null: zero
  const float* alphas;    // [H, W]
  const int32_t* last;    // [H, W]
  float4* rows;           // scratch: the gradient of every instance, [capacity, kRowQuads]; or, where
  bool by_arrival;        // this is set, of every splat, [N, kRowQuads], added up as the tiles come
};

// Where a Gaussian's gradient goes. All zero where the frame's lists were cut: such a picture is not to be learned from.
struct RawGradients {
  float* raw;  // [N, kRawColumns]; the colour is the coefficient's of the constant basis function
  float* sh;   // [N, bases, 3], or null
};

// Adam over the Gaussians themselves, in place (ops/adam/adam.h has the rule; every Gaussian takes every step).
struct FrameAdam {
  float *parameters[kRateCount], *first[kRateCount], *second[kRateCount];
  const float* rates;  // [kRateCount]
  const void* step;    // counts from 1; int64 where step_is_long, else int32
  bool step_is_long;
  double beta1, beta2;
  float epsilon;
  unsigned long long* skipped;  // [kRateCount], added to: rows that were left alone because their gradient was not finite
};

// First the rows; then per Gaussian their sum, taken back to the raw parameters.
void instance_gradients_on_device(const FrameScene& scene, const FrameLists& lists, const FrameGradients& from,
                                  cudaStream_t stream);
void splat_gradients_on_device(const FrameScene& scene, const FrameLists& lists, const FrameGradients& from,
                               const RawGradients& to, cudaStream_t stream);
void splat_gradients_adam_on_device(const FrameScene& scene, const FrameLists& lists, const FrameGradients& from,
                                    const RawGradients& to, const FrameAdam& adam, cudaStream_t stream);
