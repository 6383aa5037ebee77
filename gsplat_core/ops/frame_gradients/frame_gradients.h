// The gradient of a frame on CUDA: launch functions for the op's host code. All pointers are to device memory.
#pragma once

#include "../frame/frame.h"

namespace gsplat::frame {

constexpr int kTensors = 5;  // of the Gaussians: means, quats, log-scales, logit opacities, spherical harmonics

// Colours corrected by what the picture is off by, in place of a gradient (gsplat_core/training/steps/colour_correction.py); null: they
// have a gradient.
struct ColourCorrection {
  const float* residuals;   // [H, W, 4]: tissue (1, else 0) times picture wanted - picture shown; tissue
  const float* relaxation;  // [1]
};

// dL/dpicture, and the forward pass's results that are not in `Lists`.
struct PictureGradient {
  const float* v_image;   // [H, W, 4]: red, green, blue, sum of w z
  const float* v_alphas;  // [H, W], or null: zero
  const float* alphas;    // [H, W]
  const int32_t* last;    // [H, W]
  float4* rows;           // scratch: gradient rows, one per instance [capacity, kRowQuads], or, if `atomic`,
  bool atomic;            // one per splat [N, kRowQuads], accumulated in the order in which tiles finish
  ColourCorrection correction;
};

// Where the gradient goes; all zero if the frame overflowed, whose picture must not be learned from.
struct RawGradients {
  float* raw;  // [N, kRawColumns]; or null
  float* sh;   // [N, bases, 3], or null
};

// Adam over the Gaussians, in place (../adam/adam.h has the update rule).
struct Adam {
  float *parameters[kTensors], *first[kTensors], *second[kTensors];
  const float* rates;  // [kTensors]
  const void* step;    // counts from 1; int64 if step_is_long, else int32
  bool step_is_long;
  double beta1, beta2;
  float epsilon;
  unsigned long long* skipped;  // [kTensors], added to: rows left unchanged because their gradient was not finite
};

// First the gradient rows of all instances; then per Gaussian their sum and the chain rule to the raw parameters.
void tile_gradients(const Scene& scene, const Lists& lists, const PictureGradient& from, cudaStream_t stream);
void splat_gradients(const Scene& scene, const Lists& lists, const PictureGradient& from, const RawGradients& to,
                     cudaStream_t stream);
void splat_adam(const Scene& scene, const Lists& lists, const PictureGradient& from, const RawGradients& to, const Adam& adam,
                cudaStream_t stream);

}  // namespace gsplat::frame
