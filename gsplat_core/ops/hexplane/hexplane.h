// HexPlane features: bilinear samples of six planes multiplied, for one level. Planes are channels-last [V, U, C].
#pragma once

#include <cstdint>

#include "isa.h"

// Planes in the order xy, xz, yz, xt, yt, zt; u and v are the axes (0 x, 1 y, 2 z, 3 t) along U and V.
constexpr int kPlanes = 6;
constexpr int kPlaneAxes[kPlanes][2] = {{0, 1}, {0, 2}, {1, 2}, {0, 3}, {1, 3}, {2, 3}};

// Points whose sample gradients are held at once: small enough to stay in the cache until they are added up.
constexpr int64_t kBackwardBlock = 2048;

struct FeaturePlane {
  const float* values;
  int32_t width, height;  // U, V
};

struct HexPlanes {
  FeaturePlane planes[kPlanes];
  const float* coordinates;  // [N, 4] in [-1, 1]; values outside are clamped
  int64_t channels;
};

struct HexPlaneKernels {
  // Product of the planes first..last-1 at each point: [N, C].
  void (*product)(const HexPlanes& level, int first, int last, float* features, int64_t begin, int64_t end);
  // Per point of a block the gradient of each plane's sample, [6, kBackwardBlock, C] counted from `block`, and of the
  // coordinates [N, 4].
  void (*backward_samples)(const HexPlanes& level, const float* gradient, float* sample_gradients, float* coordinate_gradients,
                           int64_t block, int64_t begin, int64_t end);
  // Adds one plane's sample gradients of a block to channels [first, last) of its cells, points in order.
  void (*scatter)(const HexPlanes& level, int plane, const float* sample_gradients, float* plane_gradient, int64_t first,
                  int64_t last, int64_t block, int64_t end);
  // features[n, c] = space[n, c] * product over the axes of line[axis] (given [U, C]) at x, y, z of the point.
  void (*modulate)(const HexPlanes& level, const float* space, float* features, int64_t begin, int64_t end);
};
GSPLAT_DECLARE_KERNELS(HexPlaneKernels, hexplane_kernels)
