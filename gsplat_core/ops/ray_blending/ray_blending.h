// Depth along each pixel's ray and further channels, blended with the weights of compositing, forward and backward:
// interface between the host code and the kernels of both devices.
//
// The density of a splat along a ray is highest at t = (z + n.d) / (1 + l.d + d'M d), where d is the offset in pixels from
// the splat's mean to the pixel (__init__.py). The depth t is limited to z +- reach.
#pragma once

#include <cstdint>

#include "../compositing/compositing.h"

namespace gsplat::ray_blending {

// Columns of `rays`. The coefficient of dx dy in d'M d is kMxy.
constexpr int kZ = 0, kNx = 1, kNy = 2, kLx = 3, kLy = 4, kMxx = 5, kMxy = 6, kMyy = 7, kReach = 8;
constexpr int kVariance = 9;  // of depth along the ray through the mean; divided by the denominator at other pixels
constexpr int kRayNumbers = 10;
constexpr int kMaxChannels = 15;
constexpr int kMoments = compositing::kMoments;
// Sums over pixels for the gradient of `rays`, with v = dL/dt, a = v / denominator and b = -a t where t is not limited,
// c = v where it is: a, a dx, a dy, b, b dx, b dy, b dx^2, b dx dy, b dy^2, c, c with the sign of the limit.
constexpr int kRaySums = 11;
constexpr float kLeastDenominator = 1e-12f;

struct Inputs {
  compositing::Inputs splats;  // of one image, with 16x16 tiles and without colours
  const float* rays;           // [count, kRayNumbers]
  const float* values;         // [count, channels]
  int32_t channels;
};

struct Pixels {
  float* values;       // [height, width, channels]
  float* alphas;       // [height, width], as the following
  float* depths;       // weighted mean of t
  float* medians;      // t of the splat at which transmittance reaches 1/2, or 0
  float* variances;    // of depth along the ray, between splats and within them
  int32_t* last;       // position in flatten_ids of the last blended splat, or -1
  int32_t* median_at;  // position of the median's splat, or -1
};

// Inputs of the backward pass: results of the forward pass, and gradients of the loss.
struct PixelGradients {
  const float *alphas, *depths;
  const int32_t *last, *median_at;
  const float *v_values, *v_alphas, *v_depths, *v_medians;
};

struct InputGradients {
  float* means2d;    // [count, 2]
  float* conics;     // [count, 3]
  float* opacities;  // [count]
  float* rays;       // [count, kRayNumbers]
  float* values;     // [count, channels]
};

struct GradientRows {
  const int32_t* row_of;  // row of every position in flatten_ids
  float* rows;            // [instances, row_size]: moments, sums of the ray, channels
  int64_t row_size;
};

struct Kernels {
  // Prepares the splats [begin, end) for blending, in `records`.
  void (*records)(const Inputs& in, int64_t begin, int64_t end, compositing::SplatRecord* records);
  void (*tile)(const Inputs& in, const compositing::SplatRecord* records, int64_t tile, const Pixels& out);
  void (*tile_backward)(const Inputs& in, const compositing::SplatRecord* records, int64_t tile, const PixelGradients& from,
                        const GradientRows& out);
  // Sums the rows [first[i], first[i + 1]) of each splat and converts them to gradients, for splats [begin, end).
  void (*gather)(const Inputs& in, const compositing::SplatRecord* records, const GradientRows& from, const int32_t* first,
                 int64_t begin, int64_t end, const InputGradients& out);
  // Raises most[i] to the largest blending weight of splat i in a tile. Tiles may be processed concurrently.
  void (*contributions)(const compositing::Splats& splats, int64_t tile, float* most);
};

// Blending along rays, and its gradients, on CUDA; all pointers are device memory.
void blend_on_device(const Inputs& in, const Pixels& out, CudaScratch& scratch, cudaStream_t stream);
void contributions_on_device(const compositing::Inputs& in, float* most, CudaScratch& scratch, cudaStream_t stream);
void blend_backward_on_device(const Inputs& in, const PixelGradients& from, const InputGradients& out, CudaScratch& scratch,
                              cudaStream_t stream);

}  // namespace gsplat::ray_blending

GSPLAT_KERNELS(ray_blending, Kernels)
