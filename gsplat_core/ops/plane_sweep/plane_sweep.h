// Depth labels of a picture by a plane sweep (Collins 1996) and semi-global matching (Hirschmüller 2008), for the CPU.
//
// A label is a fronto-parallel plane. Its homography maps pixels of the reference picture to a view. The matching cost of
// a label at a pixel is (1 - ZNCC) / 2 of the reference and the warped view in a square window, at most kDisagrees, averaged
// over the views that see the whole window. Window sums are sums of integers and therefore exact.
#pragma once

#include <cstdint>

#include "isa.h"

namespace gsplat::plane_sweep {

constexpr int kRadius = 3, kWindow = (2 * kRadius + 1) * (2 * kRadius + 1);  // correlation window, and its number of pixels
constexpr int kGreySteps = 32;                                               // warped views are rounded to 1/32 grey level
constexpr int kMiddleGrey = 128;            // subtracted from grey levels, so that the sums of squares fit into 32 bits
constexpr float kNoiseGrey = 2;             // standard deviation of image noise, added to variances
constexpr float kSeen = 0.99f;              // smallest interpolated mask of a usable pixel
constexpr float kAgrees = 0.6f;             // correlation from which on a view agrees
constexpr int kCostSteps = 20000;           // a cost of 1 in integer units
constexpr int kDisagrees = kCostSteps / 2;  // upper bound of a cost
constexpr int kSmallStep = kCostSteps / 50, kLargeStep = kCostSteps / 10;  // penalties of a change by one label, and by more
constexpr int kNear = 2;                                                   // labels that do not compete with the best one
constexpr int64_t kMostSide = 4094, kMostLabels = 4096, kMostViews = 255;  // places of entries are exact in float32

// A pixel of a view with grey a, and its right, lower and lower right neighbours b, c and d: from the lowest bits on a, a bit
// for each usable one, and the int16 b - a, c - a and a - b - c + d.
using Corners = uint64_t;
constexpr int kUsableShift = 8;

struct Sweep {
  const uint8_t* reference;   // [height, width]
  const int32_t* sums;        // [height, width], sum over the window of the reference's grey levels minus kMiddleGrey
  const float* contrast;      // [height, width], 1 / (kWindow standard deviation of the window), 0 where it is not usable
  const Corners* views;       // [count, height + 2, width + 2], with a border of unusable black pixels
  const float* homographies;  // [labels, count, 9]
  int32_t height, width, count, labels;
};

struct Volume {
  int16_t* costs;  // [height, width, labels]
  uint8_t* votes;  // [height, width, labels], number of agreeing views
  int32_t height, width, labels;
};

// [height, width] each.
struct Selected {
  float *labels, *unique, *cost;
  uint8_t* agreeing;
};

struct Kernels {
  int64_t lanes;                             // labels per block
  int64_t (*cost_scratch)(const Sweep& in);  // bytes of scratch for `costs`
  // Computes costs of the labels [first, first + lanes).
  void (*costs)(const Sweep& in, int64_t first, uint8_t* scratch, const Volume& out);
  int64_t (*label_scratch)(const Volume& in);  // bytes of scratch for `labels`
  // Selects labels, and returns the largest cost, where negative ones count as unsigned. Above kDisagrees, nothing is selected.
  int32_t (*labels)(const Volume& in, uint8_t* scratch, const Selected& out);
};

// Return the index that replaces i in 0..size - 1 where a picture is reflected at its border pixels (OpenCV's
// BORDER_REFLECT_101).
static inline __attribute__((always_inline)) int64_t reflected(int64_t i, int64_t size) {
  if (size == 1) return 0;
  while (i < 0 || i >= size) i = i < 0 ? -i : 2 * size - 2 - i;
  return i;
}

}  // namespace gsplat::plane_sweep

GSPLAT_KERNELS(plane_sweep, Kernels)
