// Moves matched disparities a little to where two pictures agree best around them (Lucas and Kanade 1981, along the row alone),
// whatever offset of brightness is between them, and says how well the pictures tell.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::disparity_fit {

constexpr int64_t kMostSide = 1 << 20;
constexpr int kSteps = 3;
constexpr int kRadius = 12;               // of the Gaussian window, within which the pictures are compared
constexpr float kSigma = 4.0f;            // pixels
constexpr float kMostStep = 0.5f;         // pixels
constexpr float kMostFromStart = 0.7f;    // matching is right to half a pixel; a fit that goes further has left the surface
constexpr float kResistance = 4.0f;       // squared grey values per pixel below which the pictures hardly move the fit
constexpr float kOutlier = 6.0f;          // difference of grey values that counts half: highlights sit elsewhere in the other eye
constexpr float kIndependentPixels = 20;  // of the window: neighbours have the same noise and the same texture
constexpr float kLeastKnown = 1e-3f;      // share of the window
constexpr int32_t kUnknown = INT32_MIN;   // that of stereo_matching.h
constexpr float kPerSixteenth = 1.0f / 16.0f;

// A Gaussian from its middle outwards; the sum over the window is 1.
struct Taps {
  float tap[kRadius + 1];
};

// Pictures and planes are [height, width].
struct Fit {
  const uint8_t *left, *right;
  const int32_t* sixteenths;
  float *px, *error_px;  // results; 0 and infinite where nothing is known
  int32_t height, width;
  Taps taps;
};

// What is kept between the passes of a step.
struct Planes {
  float* slope;                            // of the right picture along its rows
  float *differs, *rise;                   // left minus right picture, and slope, at the current disparity; 0 where unknown
  float* known;                            // share of the window, at least kLeastKnown
  float *information, *pull, *difference;  // what the window sums: weight times slope², slope times difference, difference²
  static constexpr int kCount = 7;
};

// CPU: rows [begin, end); no result depends on how rows are cut. scratch: 3 * width + 2 * kRadius floats.
struct Kernels {
  void (*prepare)(const Fit& fit, const Planes& planes, int64_t begin, int64_t end);
  void (*share)(const Fit& fit, const Planes& planes, int64_t begin, int64_t end, float* scratch);
  void (*sample)(const Fit& fit, const Planes& planes, int64_t begin, int64_t end);
  void (*weigh)(const Fit& fit, const Planes& planes, int64_t begin, int64_t end, float* scratch);
  void (*move)(const Fit& fit, const Planes& planes, bool last, int64_t begin, int64_t end, float* scratch);
};

// CUDA; every pointer is to device memory.
void fit_on_device(const Fit& fit, CudaScratch& scratch, cudaStream_t stream);

}  // namespace gsplat::disparity_fit

GSPLAT_KERNELS(disparity_fit, Kernels)
