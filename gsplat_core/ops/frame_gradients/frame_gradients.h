// CUDA gradient of a frame: launch functions for the op's host code. All pointers are device memory.
#pragma once

#include "../frame/frame.h"

namespace gsplat::frame {

constexpr int kTensors = 5;  // parameter tensors: means, quats, log-scales, logit opacities, spherical harmonics

// Colour corrections from image residuals in place of the colours' gradient
// (gsplat_core/training/steps/photometric.py). If null, the colours have a gradient.
struct ColourCorrection {
  // [H, W, 4]: tissue mask (0 or 1) times (target - rendered) in the colours; the mask itself in the last channel
  const float* residuals;
  const float* relaxation;  // [1]
};

// dL/dimage, dL/dalphas and the results of the forward pass that are not in `Lists`.
struct PictureGradient {
  const float* v_image;   // [H, W, 4]: red, green, blue, sum of w z
  const float* v_alphas;  // [H, W], or null for zero
  const float* alphas;    // [H, W]
  const int32_t* last;    // [H, W]
  // Scratch: gradient rows, one per instance [capacity, kRowQuads], or, if `atomic`, one per splat [N, kRowQuads],
  // accumulated in the order in which tiles finish.
  float4* rows;
  bool atomic;
  ColourCorrection correction;
  // [N, kRawColumns], or null: gradient of further losses, added to that of the picture. Its colours are ignored.
  const float* added;
};

// Outputs of the gradient. All zero if the frame overflowed, because its image is incomplete and must not be trained
// on.
struct RawGradients {
  float* raw;  // [N, kRawColumns] or null
  float* sh;   // [N, bases, 3] or null
};

// In-place Adam update of the Gaussians (../adam/adam.h has the update rule).
struct Adam {
  float *parameters[kTensors], *first[kTensors], *second[kTensors];
  const float* rates;  // [kTensors]
  const void* step;    // counts from 1; int64 if step_is_long, else int32
  bool step_is_long;
  double beta1, beta2;
  float epsilon;
  unsigned long long* skipped;  // [kTensors], incremented by the number of rows skipped because of a non-finite gradient
};

// tile_gradients computes the gradient rows of all instances. The per-splat functions sum them and apply the chain rule
// to the raw parameters.
void tile_gradients(const Scene& scene, const Lists& lists, const PictureGradient& from, cudaStream_t stream);
void splat_gradients(const Scene& scene, const Lists& lists, const PictureGradient& from, const RawGradients& to,
                     cudaStream_t stream);
void splat_adam(const Scene& scene, const Lists& lists, const PictureGradient& from, const RawGradients& to, const Adam& adam,
                cudaStream_t stream);

}  // namespace gsplat::frame
