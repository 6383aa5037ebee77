// Blending of the optical flow of moving splats, forward and backward: interface between the host code and the kernels
// of both devices.
//
// Splat i carries the surface that it shows at pixel x to the point p = a_i + t_i(x) B_i d(x) in the second camera's
// axes. d is the pixel's ray in the first camera with d_z = 1. t_i is the depth at which the splat is densest on the ray.
// The weights are those of the picture and have no gradient; neither has t_i. The gradient is a second traversal in the
// same order, because it needs no sum over the splats behind.
#pragma once

#include <cstdint>

#include "../ray_blending/ray_blending.h"

namespace gsplat::flow_blending {

constexpr int kRayNumbers = ray_blending::kRayNumbers;
constexpr int kPlaneNumbers = 12;  // a, then the rows of B
constexpr int kChannels = 4;       // sums over splats of w flow_x, w flow_y, w p_z and w
constexpr float kNearest = 1e-6f;  // smallest depth of a moved point that has a pixel

struct Pinhole {
  float fx, fy, cx, cy;
};

struct Inputs : compositing::Inputs {
  const float* rays;    // [count, kRayNumbers], as in ray_blending
  const float* planes;  // [count, kPlaneNumbers]
  Pinhole before, after;
};

struct Splats {
  const Inputs& in;
  compositing::Splats listed;  // records and lists
};

// Destination of the gradients of the instances' planes: row_of maps a position in flatten_ids to a row, such that a
// splat's rows are contiguous.
struct GradientRows {
  const int32_t* row_of;
  float* rows;  // [instances, row_size]
  int64_t row_size;
};

struct Kernels {
  // Blends one tile into `out` [height, width, kChannels].
  void (*tile)(const Splats& splats, int64_t tile, float* out);
  void (*tile_backward)(const Splats& splats, int64_t tile, const float* v_out, const GradientRows& rows);
};

// Blending of flow on CUDA, forward and backward; all pointers are device memory.
void blend_on_device(const Inputs& in, float* out, CudaScratch& scratch, cudaStream_t stream);
void blend_backward_on_device(const Inputs& in, const float* v_out, float* v_planes, CudaScratch& scratch, cudaStream_t stream);

}  // namespace gsplat::flow_blending

GSPLAT_KERNELS(flow_blending, Kernels)
