// Subpixel refinement of matched disparities by minimising the squared intensity difference around each pixel (Lucas
// and Kanade 1981, along the row only). The difference is invariant to a brightness offset between the images. Also
// estimates the standard deviation of each disparity.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::disparity_fit {

constexpr int64_t kMostSide = 1 << 20;
constexpr int kSteps = 3;
constexpr int kRadius = 12;             // radius of the Gaussian window of the comparison
constexpr float kSigma = 4.0f;          // pixels
constexpr float kMostStep = 0.5f;       // pixels
constexpr float kMostFromStart = 0.7f;  // matching is accurate to half a pixel; a larger change has left the surface
constexpr float kResistance = 4.0f;     // squared grey values per pixel; damping for windows with little texture
constexpr float kOutlier = 6.0f;  // intensity difference at which the weight is one half; highlights differ between the two views
constexpr float kIndependentPixels = 20;  // effective number of pixels in the window; neighbours share noise and texture
constexpr float kLeastKnown = 1e-3f;      // minimum share of the window with known disparity
constexpr int32_t kUnknown = INT32_MIN;   // same value as in stereo_matching.h
constexpr float kPerSixteenth = 1.0f / 16.0f;

// Half of a Gaussian window, from the centre outwards; the full window sums to 1.
struct Taps {
  float tap[kRadius + 1];
};

// Inputs, settings and results of a refinement. Images and planes are [height, width].
struct Fit {
  const uint8_t *left, *right;
  const int32_t* sixteenths;
  float *px, *error_px;  // results; 0 and infinity where unknown
  int32_t height, width;
  Taps taps;
};

// Intermediate planes between the passes of a step.
struct Planes {
  float* slope;                            // of the right image along its rows
  float *differs, *rise;                   // left minus right image, and slope, at the current disparity; 0 where unknown
  float* known;                            // share of the window with known disparity, at least kLeastKnown
  float *information, *pull, *difference;  // inputs of the window sums: weight times slope², slope times difference, difference²
  static constexpr int kCount = 7;
};

// CPU kernels for rows [begin, end). Results do not depend on the partition into rows. scratch: 3 * width + 2 * kRadius
// floats.
struct Kernels {
  void (*prepare)(const Fit& fit, const Planes& planes, int64_t begin, int64_t end);
  void (*share)(const Fit& fit, const Planes& planes, int64_t begin, int64_t end, float* scratch);
  void (*sample)(const Fit& fit, const Planes& planes, int64_t begin, int64_t end);
  void (*weigh)(const Fit& fit, const Planes& planes, int64_t begin, int64_t end, float* scratch);
  void (*move)(const Fit& fit, const Planes& planes, bool last, int64_t begin, int64_t end, float* scratch);
};

// Refine disparities on CUDA; all pointers are device memory.
void fit_on_device(const Fit& fit, CudaScratch& scratch, cudaStream_t stream);

}  // namespace gsplat::disparity_fit

GSPLAT_KERNELS(disparity_fit, Kernels)
