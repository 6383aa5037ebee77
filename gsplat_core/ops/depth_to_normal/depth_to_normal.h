// Unit normals of depth maps in world axes, and their gradients by the depths.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

namespace gsplat::depth_to_normal {

constexpr float kLeastLength = 1e-18f;  // LEAST_LENGTH in gsplat_core/rendering/depth_maps.py

struct Maps {
  const float* depths;    // [images, height, width], along the axis of the camera
  const float* to_world;  // [images, 4, 4]
  const float* K;         // [images, 3, 3]
  int64_t images;
  int32_t height, width;
};

// CPU kernels for rows [begin, end) of images * height.
struct Kernels {
  void (*normals)(const Maps& maps, float* normals, int64_t begin, int64_t end);
  void (*gradients)(const Maps& maps, const float* v_normals, float* v_depths, int64_t begin, int64_t end);
};

// The same on CUDA for all rows; all pointers are device memory. normals, v_normals: [images, height, width, 3].
void normals_on_device(const Maps& maps, float* normals, cudaStream_t stream);
void gradients_on_device(const Maps& maps, const float* v_normals, float* v_depths, cudaStream_t stream);

}  // namespace gsplat::depth_to_normal

GSPLAT_KERNELS(depth_to_normal, Kernels)
