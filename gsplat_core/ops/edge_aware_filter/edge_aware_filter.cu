// One block per line solves its system by cyclic reduction: after k rounds a pixel depends only on pixels 2^k away.
#include "cuda_check.h"
#include "cuda_scratch.h"
#include "edge_aware_filter.h"

namespace gsplat::edge_aware_filter {
namespace {

constexpr int kMostThreads = 1024;

__device__ inline float link_between(const Guide& guide, int64_t one, int64_t other) {
  float squares = 0;
  for (int c = 0; c < guide.channels; ++c) {
    const float change = float(guide.pixels[one * guide.channels + c]) - float(guide.pixels[other * guide.channels + c]);
    squares += change * change;
  }
  return expf(-sqrtf(squares) * guide.per_step);
}

__global__ void __launch_bounds__(kThreads) link(Guide guide, float* right, float* down) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= int64_t(guide.height) * guide.width) return;
  const int y = int(i / guide.width), x = int(i % guide.width);
  right[i] = link_between(guide, i, x + 1 < guide.width ? i + 1 : i);
  down[i] = link_between(guide, i, y + 1 < guide.height ? i + guide.width : i);
}

// Equation of a pixel: value = known + before * value before + after * value after.
struct Equation {
  float before, after, known;
};

// Smooth one line per block. kEach: pixels per thread, kMostThreads apart.
template <int kEach>
__global__ void __launch_bounds__(kMostThreads) smooth(Lines lines, int64_t plane_size) {
  extern __shared__ Equation equations[];
  const int length = int(lines.length);
  float* const plane = lines.plane + blockIdx.y * plane_size + blockIdx.x * lines.across;
  const float* const links = lines.links + blockIdx.x * lines.across;
  Equation own[kEach];
  const auto for_own = [&](const auto& work) {
#pragma unroll
    for (int k = 0; k < kEach; ++k) {
      const int i = int(threadIdx.x) + k * int(blockDim.x);
      if (i < length) work(k, i);
    }
  };
  for_own([&](int k, int i) {
    const float before = i > 0 ? lines.strength * links[(i - 1) * lines.along] : 0.0f;
    const float after = i + 1 < length ? lines.strength * links[i * lines.along] : 0.0f;
    const float share = 1.0f / (1.0f + before + after);
    own[k] = {before * share, after * share, plane[i * lines.along] * share};
  });
  for (int away = 1; away < length; away *= 2) {
    __syncthreads();
    for_own([&](int k, int i) { equations[i] = own[k]; });
    __syncthreads();
    for_own([&](int k, int i) {
      const Equation none = {0, 0, 0}, mine = own[k];
      const Equation low = i >= away ? equations[i - away] : none, high = i + away < length ? equations[i + away] : none;
      const float share = 1.0f / (1.0f - mine.before * low.after - mine.after * high.before);
      own[k] = {mine.before * low.before * share, mine.after * high.after * share,
                (mine.known + mine.before * low.known + mine.after * high.known) * share};
    });
  }
  for_own([&](int k, int i) { plane[i * lines.along] = own[k].known; });
}

}  // namespace

void link_on_device(const Guide& guide, float* right, float* down, cudaStream_t stream) {
  link<<<blocks_for(int64_t(guide.height) * guide.width), kThreads, 0, stream>>>(guide, right, down);
}

void smooth_on_device(const Lines& lines, int64_t planes, int64_t plane_size, cudaStream_t stream) {
  const dim3 blocks(unsigned(lines.count), unsigned(planes));
  const int threads = int(lines.length < kMostThreads ? (lines.length + 31) / 32 * 32 : kMostThreads);
  const size_t shared = size_t(lines.length) * sizeof(Equation);
  if (lines.length <= kMostThreads)
    smooth<1><<<blocks, threads, shared, stream>>>(lines, plane_size);
  else
    smooth<kMostLength / kMostThreads><<<blocks, threads, shared, stream>>>(lines, plane_size);
}

}  // namespace gsplat::edge_aware_filter
