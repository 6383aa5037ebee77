// Unscented-transform projection of Gaussians through distorted lenses and rolling shutters (Wan and van der Merwe 2000; Wu
// et al. 2025): interface between the host code and the kernels of both devices.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

namespace gsplat::unscented_projection {

enum LensModel : int32_t { kPinhole = 0, kOrtho = 1, kFisheye = 2 };
// Read-out order of a rolling shutter; the values of Python's RollingShutterType.
enum ShutterKind : int32_t { kTopToBottom = 0, kLeftToRight = 1, kBottomToTop = 2, kRightToLeft = 3, kGlobal = 4 };

// Columns of `cameras`: first column of each group.
enum CameraColumn : int32_t {
  kFocal = 0,        // fx, fy
  kCenter = 2,       // cx, cy
  kRadial = 4,       // k1 to k6 of a pinhole, k1 to k4 of a fisheye lens
  kTangential = 10,  // p1, p2
  kPrism = 12,       // s1 to s4
  kLimit = 16,       // squared radius (pinhole) or angle (fisheye) from which on the lens folds over
  kRotation = 17,    // 9, row by row, at time 0
  kTranslation = 26,
  kShift = 29,  // difference of the translations at times 1 and 0
  kTurn = 32,   // rotation vector from time 0 to time 1
  kCameraColumns = 35
};

struct Size {
  int64_t batches, cameras, gaussians;  // B, C, N
};

struct Inputs {
  const float* means;      // [B, N, 3]
  const float* quats;      // [B, N, 4]
  const float* scales;     // [B, N, 3]
  const float* opacities;  // [B, N] or null
  const float* cameras;    // [B, C, kCameraColumns]
  Size size;
  LensModel model;
  ShutterKind shutter;
  bool distorted;       // false if all coefficients are zero
  float width, height;  // px
  float eps2d;          // px^2
  float near_plane, far_plane;
  float radius_clip;  // px
  float compensation_floor;
  float spread;                 // distance of a sigma point from the mean, in standard deviations
  float weight, center_weight;  // of the outer points, and of the central one in the covariance
  float margin;                 // around the picture, as a share of its size
  bool all_inside;              // all sigma points must be inside the picture and its margin, not only one
};

struct Outputs {
  int32_t* radii;        // [B, C, N, 2]
  float* means2d;        // [B, C, N, 2]
  float* depths;         // [B, C, N]
  float* conics;         // [B, C, N, 3]
  float* compensations;  // [B, C, N] or null
};

// Gradients of the outputs [B, C, N, ...], null where there is none, and of the inputs [B, N, ...], summed over cameras.
struct Gradients {
  const int32_t* radii;  // (0, 0) marks culled Gaussians
  const float *means2d, *depths, *conics, *compensations;
  float *v_means, *v_quats, *v_scales;
};

// CPU kernels for Gaussians `begin` to `end` - 1 of one image, or of one batch.
struct Kernels {
  void (*forward)(const Inputs& in, const Outputs& out, int64_t image, int64_t begin, int64_t end);
  void (*backward)(const Inputs& in, const Gradients& gradients, int64_t batch, int64_t begin, int64_t end);
};

// Unscented projection of all Gaussians to all cameras on CUDA; all pointers are device memory.
void project_on_device(const Inputs& in, const Outputs& out, cudaStream_t stream);
void project_backward_on_device(const Inputs& in, const Gradients& gradients, cudaStream_t stream);

}  // namespace gsplat::unscented_projection

GSPLAT_KERNELS(unscented_projection, Kernels)
