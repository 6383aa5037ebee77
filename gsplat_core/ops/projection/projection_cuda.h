// Projection on CUDA: what the op's host code asks of the kernels. All pointers are to device memory.
#pragma once

#include <cuda_runtime.h>

#include "projection.h"

struct ProjectionSize {
  int64_t batches, cameras, gaussians;
};

// `in` points to the first batch and camera; the kernels go on from there.
void project_on_device(const ProjectionInput& in, const ProjectionSize& size, const ProjectionOutput& out, cudaStream_t stream);

// `to.viewmat` is room for 12 sums of each of camera_sums(size) blocks, or null; the sums go to `v_viewmats` [B, C, 4, 4], which
// must be zero before. Sums are taken in a fixed order, and cameras in theirs.
void project_backward_on_device(const ProjectionInput& in, const ProjectionSize& size, const ProjectionOutputGradient& from,
                                const ProjectionInputGradient& to, float* v_viewmats, cudaStream_t stream);
int64_t camera_sums(const ProjectionSize& size);
