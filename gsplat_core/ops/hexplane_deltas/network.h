// The HexPlane field's network on CUDA: features of N Gaussians through the trunk (ReLU after each layer) and the head.
//
// The head's outputs are written to the columns of raw_layout.h; the other columns are zero. Layers up to 128 wide run
// on tensor cores, with their weights in shared memory. `FieldNetwork::fits` returns whether a network satisfies these
// limits. All pointers are device memory.
#pragma once

#include <cstddef>
#include <cstdint>

#include "cuda_stream.h"
#include "raw_layout.h"

namespace gsplat::hexplane {

constexpr int kMaxFieldLevels = 16;
constexpr int kMaxFieldLayers = 10;          // trunk layers plus the head
constexpr int kMaxPackedBytes = 200 * 1024;  // maximum size of the weights in a block's shared memory

struct FieldNetwork {
  const float* weights[kMaxFieldLayers];  // [outputs, inputs]
  const float* biases[kMaxFieldLayers];
  int32_t layers;    // number of layers: trunk and head
  int32_t features;  // inputs of the first layer
  int32_t width;     // outputs of every trunk layer

  __host__ __device__ int padded_width() const { return width <= 32 ? 32 : width <= 64 ? 64 : 128; }
  // Weight rows are padded so that a warp reads the operands of its matrix product without bank conflicts.
  __host__ __device__ int first_stride(int item) const { return features * item % 128 == 64 ? features : features + 64 / item; }
  __host__ __device__ int hidden_stride(int item) const { return padded_width() + 32 / item; }
  __host__ __device__ int hidden_start(int layer, int item) const {  // in items; layer >= 1, the last is the head
    return padded_width() * (first_stride(item) + (layer - 1) * hidden_stride(item));
  }
  __host__ __device__ int weight_items(int item) const {
    return hidden_start(layers - 1, item) + kRawColumns * hidden_stride(item);
  }
  __host__ __device__ int bias_floats() const { return (layers - 1) * padded_width() + kRawColumns; }
  __host__ __device__ size_t packed_bytes(int item) const {
    return size_t(weight_items(item)) * item + size_t(bias_floats()) * 4;
  }
  bool fits(int item) const {
    return width <= 128 && layers >= 2 && layers <= kMaxFieldLayers && features * item % 64 == 0 &&
           packed_bytes(item) <= kMaxPackedBytes;
  }
};

// Lines [U, C] of type float or __half: the time planes interpolated at one time, ordered by level, then by axis.
struct FieldLines {
  void* values;
  int64_t starts[kMaxFieldLevels][3];  // start of each line, in items
  int32_t widths[kMaxFieldLevels][3];  // U
};

struct FieldTimePlanes {
  const float* values[kMaxFieldLevels][3];  // [V, U, C]
  int32_t rows[kMaxFieldLevels][3];         // V
};

struct FieldInput {
  // [N, C] float or __half: the product of the space planes, or the complete features without lines
  const void* spaces[kMaxFieldLevels];
  FieldLines lines;          // null values: no lines
  const float* coordinates;  // [N, 4] in [-1, 1]; read only with lines
  const int32_t* order;      // row i is Gaussian order[i]; null: row i is Gaussian i
  int64_t count;
  int32_t levels, channels;
};

// Interpolate the time planes at *time in [-1, 1] into lines, and pack the network in the next kernel's shared-memory
// layout. With half, lines and weights are rounded to __half. A part whose pointer is null is skipped.
void prepare_field(const FieldTimePlanes& planes, const FieldInput& input, const float* time, const FieldNetwork* network,
                   void* packed, bool half, cudaStream_t stream);

// Compute the deltas [N, 16]. `hidden`, if not null, receives the trunk's outputs [layers - 1, N, padded width].
void field_deltas(const FieldInput& input, const FieldNetwork& network, const void* packed, bool half, float* deltas,
                  float* hidden, cudaStream_t stream);

}  // namespace gsplat::hexplane
