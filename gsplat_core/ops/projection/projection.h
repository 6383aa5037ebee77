// Projection of 3D Gaussians to screen-space ellipses (EWA splatting, Zwicker et al. 2001), forward and backward.
#pragma once

#include <cstdint>

#include "isa.h"

enum CameraModel : int32_t { kPinhole = 0, kOrtho = 1, kFisheye = 2 };

// Gaussians of one scene seen by one camera; rows of floats as torch keeps them.
struct ProjectionInput {
  const float* means;           // [N, 3]
  const float* covars;          // [N, 6], or null with the next two given
  const float* quats;           // [N, 4]
  const float* scales;          // [N, 3]
  const float* opacities;       // [N] or null
  const float* viewmat;         // [4, 4]
  const float* intrinsics;      // [3, 3]
  float width, height;          // px
  float eps2d;                  // px^2, added to the diagonal of the 2D covariance
  float near_plane, far_plane;  // z
  float radius_clip;            // px
  CameraModel model;
};

struct ProjectionOutput {
  int32_t* radii;        // [N, 2]
  float* means2d;        // [N, 2]
  float* depths;         // [N]
  float* conics;         // [N, 3]
  float* compensations;  // [N] or null
};

// Gradients of the outputs; null where nothing came.
struct ProjectionOutputGradient {
  const int32_t* radii;  // (0, 0) = culled
  const float* means2d;
  const float* depths;
  const float* conics;
  const float* compensations;
};

struct ProjectionInputGradient {
  float* means;
  float* covars;  // or null with the next two given
  float* quats;
  float* scales;
  float* viewmat;   // 12 sums over the range: rotation by rows, then translation; or null
  bool accumulate;  // add to means, covars, quats and scales (later cameras) instead of writing them
};

struct ProjectionKernels {
  void (*forward)(const ProjectionInput&, const ProjectionOutput&, int64_t begin, int64_t end);
  void (*backward)(const ProjectionInput&, const ProjectionOutputGradient&, const ProjectionInputGradient&, int64_t begin,
                   int64_t end);
};
GSPLAT_DECLARE_KERNELS(ProjectionKernels, projection_kernels)
