// World-space motion of surface points from the optical flow between two images of a pinhole camera. CPU only.
#pragma once

#include <cstdint>

#include "isa.h"

namespace gsplat::surface_motion {

constexpr int kViewNumbers = 18;   // upper three rows of world-to-camera, fx, fy, cx, cy, width, height
constexpr float kNearest = 1e-6f;  // minimum depth of a point in front of a camera (NEAREST in Python)
constexpr int kInverseSteps = 2;   // iterations of the flow inversion (INVERSE_STEPS in Python)

struct View {
  float rotation[9], translation[3];
  float fx, fy, cx, cy, width, height;
};

// Flow [height, width, 2] in pixels of `picture_width` x `picture_height`; the grid may be coarser than the image.
struct Flow {
  const float* cells;
  int64_t height, width;
  float picture_height, picture_width;
};

struct Kernels {
  // Computes the motion of points [N, 3], given at the time of the first image, to the second image.
  void (*ahead)(const View& before, const View& after, const Flow& flow, const float* points, float* motion, int64_t begin,
                int64_t end);
  // Computes the motion of points, given at the time of the second image, since the first image.
  void (*arrived)(const View& before, const View& after, const Flow& flow, const float* points, float* motion, int64_t begin,
                  int64_t end);
};

}  // namespace gsplat::surface_motion

GSPLAT_KERNELS(surface_motion, Kernels)
