// Planes smoothed within what looks like one surface in a guide picture: the fast global smoother (Min et al. 2014), weighted
// least squares along each row and then along each column, a few times with less and less strength. Each line is a tridiagonal
// system.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::edge_aware_filter {

constexpr int kRounds = 3;
constexpr float kAttenuation = 0.25f;  // of the strength, from round to round
constexpr int64_t kMostLength = 4096;  // pixels of a line
constexpr int kMostChannels = 4;

struct Guide {
  const uint8_t* pixels;  // [height, width, channels]
  int32_t height, width, channels;
  float per_step;  // links weaken by e for so many grey values: 1 / that
};

// All lines of one direction. Pixel i of line l is at l * across + i * along; it is linked with the next one by links[there].
struct Lines {
  float* plane;
  const float* links;
  int64_t count, length, along, across;
  float strength;
};

// CPU.
struct Kernels {
  // Links of the rows [begin, end) to the right and downwards: 1 where the guide does not change.
  void (*link)(const Guide& guide, float* right, float* down, int64_t begin, int64_t end);
  // Lines [begin, end). scratch: 2 * length vectors of `lanes` floats.
  void (*smooth)(const Lines& lines, int64_t begin, int64_t end, float* scratch);
  int lanes;
};

// CUDA; every pointer is to device memory. planes: [count, height, width].
void link_on_device(const Guide& guide, float* right, float* down, cudaStream_t stream);
void smooth_on_device(const Lines& lines, int64_t planes, int64_t plane_size, cudaStream_t stream);

}  // namespace gsplat::edge_aware_filter

GSPLAT_KERNELS(edge_aware_filter, Kernels)
