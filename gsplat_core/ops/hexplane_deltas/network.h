// The HexPlane field's network on CUDA: features of N Gaussians through the trunk (ReLU after each layer) and the head.
//
// The head's outputs are put into the columns of raw_layout.h, with zeros in the others. Layers up to 128 wide go through the
// tensor cores, with their weights in shared memory; `FieldNetwork::fits` says whether they do. All pointers are device memory.
#pragma once

#include <cstddef>
#include <cstdint>

#include "cuda_stream.h"
#include "raw_layout.h"

namespace gsplat::hexplane {

constexpr int kMaxFieldLevels = 16;
constexpr int kMaxFieldLayers = 10;          // trunk and head
constexpr int kMaxPackedBytes = 200 * 1024;  // of weights in a block's shared memory

struct FieldNetwork {
  const float* weights[kMaxFieldLayers];  // [outputs, inputs]
  const float* biases[kMaxFieldLayers];
  int32_t layers;    // trunk and head
  int32_t features;  // inputs of the first
  int32_t width;     // outputs of every layer of the trunk

  __host__ __device__ int padded_width() const { return width <= 32 ? 32 : width <= 64 ? 64 : 128; }
  // Rows of weights are padded so that a warp reads the operand of its matrix product without bank conflicts.
  __host__ __device__ int first_stride(int item) const { return features * item % 128 == 64 ? features : features + 64 / item; }
  __host__ __device__ int hidden_stride(int item) const { return padded_width() + 32 / item; }
  __host__ __device__ int hidden_start(int layer, int item) const {  // in items; layer >= 1, the head is the last
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

// The time planes at one time: lines [U, C] of type float or __half, level by level and axis by axis.
struct FieldLines {
  void* values;
  int64_t starts[kMaxFieldLevels][3];  // of a line, in items
  int32_t widths[kMaxFieldLevels][3];  // U
};

struct FieldTimePlanes {
  const float* values[kMaxFieldLevels][3];  // [V, U, C]
  int32_t rows[kMaxFieldLevels][3];         // V
};

struct FieldInput {
  const void* spaces[kMaxFieldLevels];  // [N, C] float or __half: the product of the space planes, or the features when there are
                                        // no lines
  FieldLines lines;                     // values null: none
  const float* coordinates;             // [N, 4] in [-1, 1]; read where there are lines
  const int32_t* order;                 // row i is Gaussian order[i]; null: i
  int64_t count;
  int32_t levels, channels;
};

// Interpolates the time planes at *time in [-1, 1] into lines, and packs the network as the next kernel keeps it in shared
// memory. With half, lines and weights are rounded to __half. Either part is skipped if its pointer is null.
void prepare_field(const FieldTimePlanes& planes, const FieldInput& input, const float* time, const FieldNetwork* network,
                   void* packed, bool half, cudaStream_t stream);

// deltas [N, 16]; `hidden`, if not null, keeps the trunk's outputs [layers - 1, N, padded width].
void field_deltas(const FieldInput& input, const FieldNetwork& network, const void* packed, bool half, float* deltas,
                  float* hidden, cudaStream_t stream);

}  // namespace gsplat::hexplane
