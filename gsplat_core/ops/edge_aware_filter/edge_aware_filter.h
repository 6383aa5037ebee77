// Edge-aware smoothing of planes by a guide image: the fast global smoother (Min et al. 2014). It solves a weighted
// least-squares problem along each row and then along each column, for a few rounds with decreasing strength. Each line
// is a tridiagonal system.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::edge_aware_filter {

constexpr int kRounds = 3;
constexpr float kAttenuation = 0.25f;  // factor of the strength per round
constexpr int64_t kMostLength = 4096;  // maximum pixels per line
constexpr int kMostChannels = 4;

struct Guide {
  const uint8_t* pixels;  // [height, width, channels]
  int32_t height, width, channels;
  float per_step;  // 1 / (grey-value step at which a link weakens by a factor of e)
};

// All lines of one direction. Pixel i of line l is at l * across + i * along, and links[that index] connects it to the
// next pixel.
struct Lines {
  float* plane;
  const float* links;
  int64_t count, length, along, across;
  float strength;
};

// CPU kernels.
struct Kernels {
  // Computes the links of rows [begin, end) to the right and downwards; 1 where the guide is constant.
  void (*link)(const Guide& guide, float* right, float* down, int64_t begin, int64_t end);
  // Smooths lines [begin, end). scratch: 2 * length vectors of `lanes` floats.
  void (*smooth)(const Lines& lines, int64_t begin, int64_t end, float* scratch);
  int lanes;
};

// Edge-aware filter on CUDA: weights between neighbours, then smoothing of planes [count, height, width]. All pointers
// are device memory.
void link_on_device(const Guide& guide, float* right, float* down, cudaStream_t stream);
void smooth_on_device(const Lines& lines, int64_t planes, int64_t plane_size, cudaStream_t stream);

}  // namespace gsplat::edge_aware_filter

GSPLAT_KERNELS(edge_aware_filter, Kernels)
