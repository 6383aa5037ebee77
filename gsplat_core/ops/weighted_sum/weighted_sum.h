// Sums over splats, without an order (Hou et al. 2024, "Sort-free Gaussian Splatting via Weighted Sum Rendering"):
// interface between the host code and the kernels of both devices.
//
// A pixel's sums are S_k = sum_i t_i c_ik and S_D = sum_i t_i with t_i = w_i o_i G_i(pixel). They are added in fixed point
// with a quantum of 2^-32, so that the result does not depend on the order of the splats. The sums of a pixel may reach 2^31.
#pragma once

#include <cstdint>

#include "constants.h"
#include "cuda_stream.h"
#include "isa.h"

namespace gsplat::weighted_sum {

constexpr float kMostTerm = 128.0f;      // |t| is limited to this, so that |t c| < 2^19; a limited term has no gradient
constexpr float kMostChannel = 2048.0f;  // |c| is limited to this; a limited channel has no gradient
constexpr double kScale = 4294967296.0;  // 2^32
constexpr float kInverseScale = 2.3283064365386963e-10f;
// Constant for rounding: adding 1.5 * 2^52 to a double below 2^51 rounds it to an integer, which the low bits then
// contain.
constexpr double kMagic = 6755399441055744.0;
constexpr int64_t kMagicBits = 0x4338000000000000;
constexpr int kMostChannels = 32;
constexpr int kMoments = 6;  // sum over pixels of s, s dx, s dy, s dx^2, s dx dy, s dy^2, where s = a dL/dt

struct Inputs {
  const float* means2d;    // [count, 2]
  const float* conics;     // [count, 3]
  const float* channels;   // [count, channel_count]
  const float* opacities;  // [count], of either sign
  const float* weights;    // [count], of either sign
  const int32_t* offsets;  // [tile_height, tile_width]
  const int32_t* flatten_ids;
  int64_t count, instances;
  int32_t channel_count, width, height, tile_width, tile_height;
};

struct InputGradients {
  float* means2d;
  float* conics;
  float* channels;
  float* opacities;
  float* weights;
};

// CPU: one splat prepared for the pixels. log2(|o| G) = a dx^2 + b dx dy + c dy^2 + l with (dx, dy) from the mean to the
// pixel. Pixels below `threshold` are skipped. The extents are negative for a splat without pixels.
struct SplatRecord {
  float x, y, a, b, c, l, threshold, half_width, half_height;
  float sign;  // of the opacity
};

struct Kernels {
  void (*records)(const Inputs& in, int64_t begin, int64_t end, SplatRecord* records);
  // Sums [channel_count + 1, height, width] of a tile's pixels.
  void (*tile)(const Inputs& in, const SplatRecord* records, int64_t tile, float* sums);
  // Gradients of splats `begin` to `end` - 1 from those of the sums.
  void (*backward)(const Inputs& in, const SplatRecord* records, const float* v_sums, int64_t begin, int64_t end,
                   const InputGradients& out);
};

// Weighted sums on CUDA, forward and backward; all pointers are device memory.
void weighted_sums_on_device(const Inputs& in, float* sums, cudaStream_t stream);
void weighted_sums_backward_on_device(const Inputs& in, const float* v_sums, const InputGradients& out, cudaStream_t stream);

}  // namespace gsplat::weighted_sum

GSPLAT_KERNELS(weighted_sum, Kernels)
