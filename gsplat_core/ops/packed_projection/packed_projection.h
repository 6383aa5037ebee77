// Projection of visible pairs of camera and Gaussian only: interface between the host code and the CUDA kernels. The CPU
// uses the kernels of ../projection on gathered rows.
//
// A row is a visible pair. Its id is (batch * cameras + camera) * gaussians + gaussian; ids ascend.
#pragma once

#include <cstdint>

#include "../projection/projection.h"
#include "cuda_scratch.h"
#include "cuda_stream.h"

namespace gsplat::packed_projection {

using projection::ProjectionInput;
using projection::ProjectionSize;

// Visibility of all (image, Gaussian) pairs, and the first output row of each block of pairs.
struct Visible {
  uint32_t* bits;   // one bit per pair, 32 pairs of one image per word; blocks(size) * 8 words
  int64_t* starts;  // [blocks(size) + 1]; the last value is the number of rows
};

struct Rows {
  const int64_t* ids;
  int64_t count;
};

struct RowOutput {
  int64_t* ids;
  int32_t* radii;        // [rows, 2]
  float* means2d;        // [rows, 2]
  float* depths;         // [rows]
  float* conics;         // [rows, 3]
  float* compensations;  // [rows] or null
};

// Gradients of the outputs of each row; null where there is none.
struct RowOutputGradient {
  const float *means2d, *depths, *conics, *compensations;
};

// Gradients of the inputs of each row.
struct RowGradient {
  float* means;    // [rows, 3]
  float* covars;   // [rows, 6]; null if quats and scales are given
  float* quats;    // [rows, 4]
  float* scales;   // [rows, 3]
  float* viewmat;  // null, or 12 sums per block of pairs
};

// Number of blocks of kThreads pairs; a block contains pairs of one image.
int64_t blocks(const ProjectionSize& size);
Visible find_visible(const ProjectionInput& in, const ProjectionSize& size, bool compensate, CudaScratch& scratch,
                     cudaStream_t stream);
void emit_rows(const ProjectionInput& in, const ProjectionSize& size, const Visible& visible, const RowOutput& out,
               cudaStream_t stream);
// Compute the gradient of each row. `v_viewmats` [B, C, 4, 4] must be zeroed. The sums of `to.viewmat` are added to it
// in a fixed order.
void rows_backward(const ProjectionInput& in, const ProjectionSize& size, const Rows& rows, const RowOutputGradient& from,
                   const RowGradient& to, float* v_viewmats, cudaStream_t stream);
// Add values [rows, columns] to `out` [B, N, columns], camera by camera.
void add_rows(const ProjectionSize& size, const Rows& rows, const float* values, int64_t columns, float* out,
              cudaStream_t stream);

}  // namespace gsplat::packed_projection
