// World-space motion of surface points from the optical flow between images of a pinhole camera. The motion between two
// images is for the CPU, the path through several images for both devices.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
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

// Flow between consecutive images, and their views in the order of the path.
struct Flows {
  const float* cells;  // [steps, height, width, 2]
  const float* views;  // [steps + 1, kViewNumbers]
  int64_t steps, height, width;
};

// Read a view from kViewNumbers numbers: three rows of world-to-camera, fx, fy, cx, cy, width, height.
template <class Number>
GSPLAT_HOST_DEVICE View view_of(const Number* numbers) {
  View v;
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) v.rotation[3 * row + column] = float(numbers[4 * row + column]);
    v.translation[row] = float(numbers[4 * row + 3]);
  }
  v.fx = float(numbers[12]), v.fy = float(numbers[13]), v.cx = float(numbers[14]), v.cy = float(numbers[15]);
  v.width = float(numbers[16]), v.height = float(numbers[17]);
  return v;
}

struct Kernels {
  // Computes the motion of points [N, 3], given at the time of the first image, to the second image.
  void (*ahead)(const View& before, const View& after, const Flow& flow, const float* points, float* motion, int64_t begin,
                int64_t end);
  // Computes the motion of points, given at the time of the second image, since the first image.
  void (*arrived)(const View& before, const View& after, const Flow& flow, const float* points, float* motion, int64_t begin,
                  int64_t end);
  // Writes the positions [N, steps, 3] of points [N, 3] after each step of the flows.
  void (*path)(const Flows& flows, const float* points, float* positions, int64_t begin, int64_t end);
};

// `Kernels::path` for all points on CUDA; all pointers are device memory.
void path_on_device(const Flows& flows, const float* points, float* positions, int64_t count, cudaStream_t stream);

}  // namespace gsplat::surface_motion

GSPLAT_KERNELS(surface_motion, Kernels)
