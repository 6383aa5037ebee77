// Motion of surface points in the world, from the flow between two pictures of a pinhole camera. CPU only.
#pragma once

#include <cstdint>

#include "isa.h"

namespace gsplat::surface_motion {

constexpr int kViewNumbers = 18;   // the upper three rows of world-to-camera, fx, fy, cx, cy, width, height
constexpr float kNearest = 1e-6f;  // depth below which a point is not in front of a camera (NEAREST in Python)
constexpr int kInverseSteps = 2;   // iterations to find where a pixel came from (INVERSE_STEPS in Python)

struct View {
  float rotation[9], translation[3];
  float fx, fy, cx, cy, width, height;
};

// Flow [height, width, 2] in pixels of `picture_width` x `picture_height`, however many cells it has.
struct Flow {
  const float* cells;
  int64_t height, width;
  float picture_height, picture_width;
};

struct Kernels {
  // Points [N, 3] as they are in the first picture; how they move to the second.
  void (*ahead)(const View& before, const View& after, const Flow& flow, const float* points, float* motion, int64_t begin,
                int64_t end);
  // Points as they are in the second picture; how they moved there.
  void (*arrived)(const View& before, const View& after, const Flow& flow, const float* points, float* motion, int64_t begin,
                  int64_t end);
};

}  // namespace gsplat::surface_motion

GSPLAT_KERNELS(surface_motion, Kernels)
