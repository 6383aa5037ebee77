// HexPlane features of one level (the product of bilinear samples of six planes) and factorised inference: interface
// between the host code and the kernels of both devices. Planes are channels-last [V, U, C].
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::hexplane {

// Planes in the order xy, xz, yz, xt, yt, zt; u and v are the axes (0 x, 1 y, 2 z, 3 t) along U and V.
constexpr int kPlanes = 6;
constexpr int kPlaneAxes[kPlanes][2] = {{0, 1}, {0, 2}, {1, 2}, {0, 3}, {1, 3}, {2, 3}};

struct FeaturePlane {
  const float* values;
  int32_t width, height;  // U, V
};

struct HexPlanes {
  FeaturePlane planes[kPlanes];
  const float* coordinates;  // [N, 4] in [-1, 1]; values outside are clamped
  int64_t channels;
};

// Largest numbers of levels and layers for inference at a fixed time, which multiplies cached space features by three
// lines per level and decodes them by an MLP with ReLU between its layers.
constexpr int kMaxLevels = 16;
constexpr int kMaxLayers = 66;

struct DecodeLevel {
  const float* space;     // [N, C]
  const float* lines[3];  // [U, C]: time planes interpolated at the time; null if `space` already holds the features
  int32_t widths[3];      // U
  int64_t channels;
};

struct DecodeLayer {
  const float* weights;  // [inputs, padded outputs]: transposed and zero-padded
  const float* bias;     // [padded outputs]
  int64_t inputs, padded_outputs;
};

struct Decode {
  DecodeLevel levels[kMaxLevels];
  DecodeLayer layers[kMaxLayers];
  int level_count, layer_count;
  const float* coordinates;  // [N, 4] in [-1, 1]
  float* outputs;            // [N, output_count]
  int64_t output_count;
  int64_t stride;  // floats per buffer row; at least the features and every layer's padded outputs
};

// CPU: points whose sample gradients are stored at once; small enough to stay in the cache until they are summed.
constexpr int64_t kBackwardBlock = 2048;
// CPU: Gaussians processed through all layers while in the L1 cache; a multiple of every micro-kernel's rows.
constexpr int64_t kBlockRows = 48;

struct Kernels {
  // Computes the product of the planes first..last-1 at each point: [N, C].
  void (*product)(const HexPlanes& level, int first, int last, float* features, int64_t begin, int64_t end);
  // Computes for each point of a block the gradient of each plane's sample, [6, kBackwardBlock, C] with point indices
  // relative to `block`, and of the coordinates [N, 4].
  void (*backward_samples)(const HexPlanes& level, const float* gradient, float* sample_gradients, float* coordinate_gradients,
                           int64_t block, int64_t begin, int64_t end);
  // Adds one plane's sample gradients of a block to channels [first, last) of its cells, in point order.
  void (*scatter)(const HexPlanes& level, int plane, const float* sample_gradients, float* plane_gradient, int64_t first,
                  int64_t last, int64_t block, int64_t end);
  // Computes features[n, c] = space[n, c] * product over the axes of line[axis] (given [U, C]) at the point's x, y, z.
  void (*modulate)(const HexPlanes& level, const float* space, float* features, int64_t begin, int64_t end);
  int lanes;  // padding multiple of a decoded layer's outputs
  // Decodes the features of Gaussians by the MLP. `buffer` holds 2 * kBlockRows * stride floats.
  void (*decode)(const Decode& d, float* buffer, int64_t begin, int64_t end);
};

// HexPlane features on CUDA; all pointers are device memory. plane_product computes the product of the planes
// first..last-1 at each point: [N, C].
void plane_product(const HexPlanes& level, int first, int last, float* features, int64_t count, cudaStream_t stream);
// features = space times the three lines (given as planes of height 1) at the point's x, y, z.
void modulate_lines(const HexPlanes& level, const float* space, float* features, int64_t count, cudaStream_t stream);
// Gradients of the product of all six planes: of the coordinates [N, 4] and of each plane.
void plane_gradients(const HexPlanes& level, const float* gradient, float* v_coordinates, float* const* v_planes, int64_t count,
                     CudaScratch& scratch, cudaStream_t stream);
// out [N, outputs] = in [N, inputs] weight^T + bias, with weight [outputs, inputs]. Rows of `in` and `out` may be
// longer.
void linear_layer(const float* in, int64_t in_stride, const float* weight, const float* bias, float* out, int64_t out_stride,
                  int64_t count, int inputs, int outputs, bool rectify, cudaStream_t stream);

}  // namespace gsplat::hexplane

GSPLAT_KERNELS(hexplane, Kernels)
