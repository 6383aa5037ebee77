// HexPlane features on CUDA: what the ops' host code asks of the kernels. All pointers are to device memory.
#pragma once

#include <cuda_runtime.h>

#include "cuda_scratch.h"
#include "hexplane.h"

// Product of the planes first..last-1 at each point: [N, C].
void plane_product(const HexPlanes& level, int first, int last, float* features, int64_t count, cudaStream_t stream);

// features = space times the three lines (given as planes of height 1) at x, y, z.
void modulate_lines(const HexPlanes& level, const float* space, float* features, int64_t count, cudaStream_t stream);

// Gradients of all six planes' product: of the coordinates [N, 4] and of each plane.
void plane_gradients(const HexPlanes& level, const float* gradient, float* v_coordinates, float* const* v_planes, int64_t count,
                     CudaScratch& scratch, cudaStream_t stream);

// out [N, outputs] = in [N, inputs] weight^T + bias; weight [outputs, inputs]. Rows of `in` and `out` may be longer than that.
void linear_layer(const float* in, int64_t in_stride, const float* weight, const float* bias, float* out, int64_t out_stride,
                  int64_t count, int inputs, int outputs, bool rectify, cudaStream_t stream);
