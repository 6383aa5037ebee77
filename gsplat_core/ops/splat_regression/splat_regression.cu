// Forward: one point per thread, splats through shared memory. Backward: one block per splat and part of the points; the
// parts are added in order by a second kernel.
#include "cuda_scratch.h"
#include "splat_regression.h"
#include "splat_regression_math.h"

namespace gsplat::splat_regression {
namespace {

constexpr float kLog2E = 1.44269504f;
constexpr int kChunk = 4;        // channels per thread block
constexpr int kStage = 64;       // splats in shared memory
constexpr int64_t kPart = 4096;  // minimum points of a part
constexpr int64_t kMaxParts = 64;
constexpr int kWarps = kThreads / 32;
constexpr unsigned kAll = 0xffffffffu;

__global__ void __launch_bounds__(kThreads) prepare(Inputs in, Splat* records) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < in.splats) records[i] = prepared(in, i, [](double x) { return ::log2(x); });
}

// Return g at a point, and y = A^-1 (x - b) in `y`. Gives 0 for non-finite points and unusable splats.
template <int D>
__device__ __forceinline__ float density(const Splat& s, const float* x, float* y) {
  float squared = 0, offset[D];
#pragma unroll
  for (int k = 0; k < D; ++k) offset[k] = x[k] - s.centre[k];
#pragma unroll
  for (int r = 0; r < D; ++r) {
    y[r] = 0;
#pragma unroll
    for (int k = 0; k < D; ++k) y[r] = fmaf(s.whiten[r * D + k], offset[k], y[r]);
    squared = fmaf(y[r], y[r], squared);
  }
  const float power = fmaf(-0.5f * kLog2E, squared, s.log2_norm);
  return power >= -126.0f ? exp2f(fminf(power, 126.0f)) : 0.0f;
}

template <int D>
__global__ void __launch_bounds__(kThreads) forward(Inputs in, const Splat* __restrict__ records, float* __restrict__ out) {
  __shared__ Splat splats[kStage];
  __shared__ float values[kStage][kChunk];
  const int64_t point = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int first = int(blockIdx.y) * kChunk, channels = min(kChunk, in.channels - first);
  float x[D], y[D], sums[kChunk] = {};
#pragma unroll
  for (int k = 0; k < D; ++k) x[k] = point < in.count ? in.points[point * D + k] : 0.0f;
  for (int64_t stage = 0; stage < in.splats; stage += kStage) {
    const int staged = int(min(int64_t(kStage), in.splats - stage));
    __syncthreads();
    for (int i = threadIdx.x; i < staged; i += kThreads) splats[i] = records[stage + i];
    for (int i = threadIdx.x; i < staged * kChunk; i += kThreads) {
      const int s = i / kChunk, c = i % kChunk;
      values[s][c] = c < channels ? in.values[(stage + s) * in.channels + first + c] : 0.0f;
    }
    __syncthreads();
    for (int s = 0; s < staged; ++s) {
      if (!(splats[s].log2_norm > -INFINITY)) continue;
      const float g = density<D>(splats[s], x, y);
#pragma unroll
      for (int c = 0; c < kChunk; ++c) sums[c] = fmaf(values[s][c], g, sums[c]);
    }
  }
  if (point >= in.count) return;
  for (int c = 0; c < channels; ++c) out[point * in.channels + first + c] = sums[c];
}

// Sum a value over the block in a fixed order; the result is in thread 0.
__device__ __forceinline__ float block_sum(float value, float* shared) {
  for (int mask = 16; mask > 0; mask /= 2) value += __shfl_xor_sync(kAll, value, mask);
  __syncthreads();
  if (threadIdx.x % 32 == 0) shared[threadIdx.x / 32] = value;
  __syncthreads();
  float total = 0;
  if (threadIdx.x == 0)
    for (int w = 0; w < kWarps; ++w) total += shared[w];
  return total;
}

// Sum the gradient terms of each splat over parts of the points. Grid: splats, parts, chunks of channels. Writes rows
// [splats, parts, columns].
template <int D>
__global__ void __launch_bounds__(kThreads)
    sum_part(Inputs in, const Splat* __restrict__ records, const float* __restrict__ gradient, int64_t part_size, float* rows) {
  constexpr int kMoments = moments_of(D);
  __shared__ float shared[kWarps];
  const int64_t splat = blockIdx.x, part = blockIdx.y;
  const int first = int(blockIdx.z) * kChunk, channels = min(kChunk, in.channels - first);
  const Splat s = records[splat];
  const bool usable = s.log2_norm > -INFINITY;
  const float* const value = in.values + splat * in.channels;
  float moments[kMoments] = {}, channel_sums[kChunk] = {};
  const int64_t stop = min((part + 1) * part_size, in.count);
  for (int64_t i = part * part_size + threadIdx.x; usable && i < stop; i += kThreads) {
    float x[D], y[D];
#pragma unroll
    for (int k = 0; k < D; ++k) x[k] = in.points[i * D + k];
    const float g = density<D>(s, x, y);
    if (g == 0.0f) continue;
    for (int c = 0; c < channels; ++c) {
      // The index is constant after unrolling, so that the sums stay in registers.
#pragma unroll
      for (int k = 0; k < kChunk; ++k)
        if (k == c) channel_sums[k] = fmaf(g, gradient[i * in.channels + first + c], channel_sums[k]);
    }
    if (blockIdx.z != 0) continue;
    float along = 0;
    for (int c = 0; c < in.channels; ++c) along = fmaf(value[c], gradient[i * in.channels + c], along);
    const float h = g * along;
    moments[0] += h;
    int next = 1 + D;
#pragma unroll
    for (int r = 0; r < D; ++r) {
      const float weighted = h * y[r];
      moments[1 + r] += weighted;
#pragma unroll
      for (int k = r; k < D; ++k, ++next) moments[next] = fmaf(weighted, y[k], moments[next]);
    }
  }
  float* const row = rows + (splat * gridDim.y + part) * (kMoments + in.channels);
  if (blockIdx.z == 0) {
#pragma unroll
    for (int k = 0; k < kMoments; ++k) {
      const float total = block_sum(moments[k], shared);
      if (threadIdx.x == 0) row[k] = total;
    }
  }
#pragma unroll
  for (int c = 0; c < kChunk; ++c) {
    const float total = block_sum(channel_sums[c], shared);
    if (threadIdx.x == 0 && c < channels) row[kMoments + first + c] = total;
  }
}

__global__ void __launch_bounds__(kThreads)
    finish(Inputs in, const Splat* __restrict__ records, const float* __restrict__ rows, int parts, Gradients out) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.splats) return;
  const int count = moments_of(in.dims), columns = count + in.channels;
  const float* const mine = rows + i * parts * columns;
  double moments[kMaxMoments];
  for (int k = 0; k < count; ++k) {
    moments[k] = 0;
    for (int p = 0; p < parts; ++p) moments[k] += double(mine[int64_t(p) * columns + k]);
  }
  gradients_of(in, i, records[i], moments, out);
  for (int c = 0; c < in.channels; ++c) {
    double total = 0;
    for (int p = 0; p < parts; ++p) total += double(mine[int64_t(p) * columns + count + c]);
    out.values[i * in.channels + c] = float(total);
  }
}

const Splat* records_of(const Inputs& in, CudaScratch& scratch, cudaStream_t stream) {
  Splat* const records = scratch.array<Splat>(in.splats);
  if (in.splats > 0) prepare<<<blocks_for(in.splats), kThreads, 0, stream>>>(in, records);
  return records;
}

template <int D>
void launch_forward(const Inputs& in, const Splat* records, float* out, cudaStream_t stream) {
  const dim3 grid(blocks_for(in.count), unsigned((in.channels + kChunk - 1) / kChunk));
  forward<D><<<grid, kThreads, 0, stream>>>(in, records, out);
}

template <int D>
void launch_sums(const Inputs& in, const Splat* records, const float* gradient, int64_t parts, float* rows, cudaStream_t stream) {
  const unsigned chunks = unsigned(in.channels > 0 ? (in.channels + kChunk - 1) / kChunk : 1);
  const dim3 grid(unsigned(in.splats), unsigned(parts), chunks);
  sum_part<D><<<grid, kThreads, 0, stream>>>(in, records, gradient, (in.count + parts - 1) / parts, rows);
}

}  // namespace

void regress_on_device(const Inputs& in, float* out, CudaScratch& scratch, cudaStream_t stream) {
  if (in.count == 0 || in.channels == 0) return;
  const Splat* const records = records_of(in, scratch, stream);
  switch (in.dims) {
    case 1: return launch_forward<1>(in, records, out, stream);
    case 2: return launch_forward<2>(in, records, out, stream);
    case 3: return launch_forward<3>(in, records, out, stream);
    default: return launch_forward<4>(in, records, out, stream);
  }
}

void regress_backward_on_device(const Inputs& in, const float* gradient, const Gradients& out, CudaScratch& scratch,
                                cudaStream_t stream) {
  if (in.splats == 0) return;
  const Splat* const records = records_of(in, scratch, stream);
  int64_t parts = in.count / kPart;
  parts = parts < 1 ? 1 : parts > kMaxParts ? kMaxParts : parts;
  float* const rows = scratch.array<float>(in.splats * parts * (moments_of(in.dims) + in.channels));
  switch (in.dims) {
    case 1: launch_sums<1>(in, records, gradient, parts, rows, stream); break;
    case 2: launch_sums<2>(in, records, gradient, parts, rows, stream); break;
    case 3: launch_sums<3>(in, records, gradient, parts, rows, stream); break;
    default: launch_sums<4>(in, records, gradient, parts, rows, stream); break;
  }
  finish<<<blocks_for(in.splats), kThreads, 0, stream>>>(in, records, rows, int(parts), out);
}

}  // namespace gsplat::splat_regression
