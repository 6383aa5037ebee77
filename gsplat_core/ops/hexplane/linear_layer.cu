// A dense layer of any size in float32: tiles of 64 rows and 64 outputs in shared memory, 4 x 4 of them a thread.
#include "hexplane_cuda.h"

namespace {

constexpr int kTile = 64, kDeep = 16;

__global__ void __launch_bounds__(kThreads)
    linear(const float* __restrict__ in, int64_t in_stride, const float* __restrict__ weight, const float* __restrict__ bias,
           float* __restrict__ out, int64_t out_stride, int64_t count, int inputs, int outputs, bool rectify) {
  __shared__ float rows[kDeep][kTile + 4], columns[kDeep][kTile + 4];
  const int64_t first_row = int64_t(blockIdx.x) * kTile;
  const int first_output = int(blockIdx.y) * kTile, r = int(threadIdx.x) / 16 * 4, o = int(threadIdx.x) % 16 * 4;
  float sums[4][4] = {};
  for (int k0 = 0; k0 < inputs; k0 += kDeep) {
    for (int i = int(threadIdx.x); i < kTile * kDeep; i += kThreads) {
      const int k = i % kDeep, at = i / kDeep;
      const bool inside = k0 + k < inputs;
      rows[k][at] = inside && first_row + at < count ? in[(first_row + at) * in_stride + k0 + k] : 0.0f;
      columns[k][at] = inside && first_output + at < outputs ? weight[int64_t(first_output + at) * inputs + k0 + k] : 0.0f;
    }
    __syncthreads();
#pragma unroll
    for (int k = 0; k < kDeep; ++k)
#pragma unroll
      for (int i = 0; i < 4; ++i)
#pragma unroll
        for (int j = 0; j < 4; ++j) sums[i][j] += rows[k][r + i] * columns[k][o + j];
    __syncthreads();
  }
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < 4; ++j) {
      if (first_row + r + i >= count || first_output + o + j >= outputs) continue;
      const float x = sums[i][j] + bias[first_output + o + j];
      out[(first_row + r + i) * out_stride + first_output + o + j] = rectify && x < 0.0f ? 0.0f : x;  // NaN stays and shows
    }
}

}  // namespace

void linear_layer(const float* in, int64_t in_stride, const float* weight, const float* bias, float* out, int64_t out_stride,
                  int64_t count, int inputs, int outputs, bool rectify, cudaStream_t stream) {
  if (count == 0 || outputs == 0) return;
  const dim3 grid(blocks_for(count, kTile), blocks_for(outputs, kTile));
  linear<<<grid, kThreads, 0, stream>>>(in, in_stride, weight, bias, out, out_stride, count, inputs, outputs, rectify);
}
