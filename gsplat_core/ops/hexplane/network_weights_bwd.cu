// The gradient of the network's weights: outer products of what went into a layer and what came back to it, summed over
// Gaussians. Every block sums a tile of one layer over its share of the Gaussians; the shares are then added in their order.
#include "network_cuda.h"
#include "training_cuda.h"

namespace {

constexpr int kShares = 256;
constexpr int kOutputs = 32, kInputs = 64, kDeep = 16, kTileThreads = 128;

struct LayerTiles {
  const float *inputs[kFieldLayers], *v_outputs[kFieldLayers];  // [N, input_count], [N, output_count] (the head's in columns)
  int32_t input_count[kFieldLayers], output_count[kFieldLayers];
  int32_t first_tile[kFieldLayers + 1];
  int32_t first_value[kFieldLayers + 1];  // of a layer in a share: weights [outputs, inputs], then biases
  int32_t layers;
};

__global__ void __launch_bounds__(kTileThreads, 8) sum_shares(LayerTiles tiles, float* __restrict__ shares, int64_t count) {
  __shared__ __align__(16) float v[kDeep][kOutputs], x[kDeep][kInputs];
  int layer = 0;
  while (int(blockIdx.x) >= tiles.first_tile[layer + 1]) ++layer;
  const int inputs = tiles.input_count[layer], outputs = tiles.output_count[layer], across = (inputs + kInputs - 1) / kInputs;
  const int tile = int(blockIdx.x) - tiles.first_tile[layer], first_output = tile / across * kOutputs,
            first_input = tile % across * kInputs;
  const int64_t begin = count * blockIdx.y / kShares, end = count * (blockIdx.y + 1) / kShares;
  const int o = int(threadIdx.x) / 16 * 4, i = int(threadIdx.x) % 16 * 4;
  constexpr int kV = kDeep * kOutputs / kTileThreads, kX = kDeep * kInputs / kTileThreads;
  float sums[4][4] = {}, bias = 0.0f, next_v[kV], next_x[kX];
  // A thread has one column of each operand. The next rows are on their way while these are multiplied.
  const int v_row = int(threadIdx.x) / kOutputs, v_output = first_output + int(threadIdx.x) % kOutputs;
  const int x_row = int(threadIdx.x) / kInputs, x_input = first_input + int(threadIdx.x) % kInputs;
  const float* v_from = tiles.v_outputs[layer] + (begin + v_row) * outputs + v_output;
  const float* x_from = tiles.inputs[layer] + (begin + x_row) * inputs + x_input;
  const auto fetch = [&](int64_t row) {
    const int left = int(end - row);
#pragma unroll
    for (int k = 0; k < kV; ++k) {
      const int down = k * (kTileThreads / kOutputs);
      next_v[k] = v_row + down < left && v_output < outputs ? v_from[down * outputs] : 0.0f;
    }
#pragma unroll
    for (int k = 0; k < kX; ++k) {
      const int down = k * (kTileThreads / kInputs);
      next_x[k] = x_row + down < left && x_input < inputs ? x_from[down * inputs] : 0.0f;
    }
    v_from += kDeep * outputs;
    x_from += kDeep * inputs;
  };
  fetch(begin);
  for (int64_t row = begin; row < end; row += kDeep) {
    __syncthreads();
#pragma unroll
    for (int k = 0; k < kV; ++k) (&v[0][0])[k * kTileThreads + threadIdx.x] = next_v[k];
#pragma unroll
    for (int k = 0; k < kX; ++k) (&x[0][0])[k * kTileThreads + threadIdx.x] = next_x[k];
    __syncthreads();
    if (row + kDeep < end) fetch(row + kDeep);
#pragma unroll
    for (int k = 0; k < kDeep; ++k) {
      const float4 a = *reinterpret_cast<const float4*>(&v[k][o]), b = *reinterpret_cast<const float4*>(&x[k][i]);
      const float left[4] = {a.x, a.y, a.z, a.w}, right[4] = {b.x, b.y, b.z, b.w};
#pragma unroll
      for (int p = 0; p < 4; ++p)
#pragma unroll
        for (int q = 0; q < 4; ++q) sums[p][q] += left[p] * right[q];
      if (threadIdx.x < kOutputs) bias += v[k][threadIdx.x];
    }
  }
  float* to = shares + int64_t(blockIdx.y) * tiles.first_value[tiles.layers] + tiles.first_value[layer];
  for (int p = 0; p < 4; ++p)
    for (int q = 0; q < 4; ++q)
      if (first_output + o + p < outputs && first_input + i + q < inputs)
        to[(first_output + o + p) * inputs + first_input + i + q] = sums[p][q];
  if (first_input == 0 && threadIdx.x < kOutputs && first_output + int(threadIdx.x) < outputs)
    to[outputs * inputs + first_output + threadIdx.x] = bias;
}

// The head's outputs leave their columns here.
__global__ void __launch_bounds__(kThreads) add_shares(LayerTiles tiles, const float* __restrict__ shares, float* gradient) {
  __shared__ float partial[4][kThreads / 4];
  const int at = int(blockIdx.x) * (kThreads / 4) + int(threadIdx.x) % (kThreads / 4),
            quarter = int(threadIdx.x) / (kThreads / 4);
  const int total = tiles.first_value[tiles.layers];
  float sum = 0.0f;
  if (at < total)
#pragma unroll 8
    for (int share = quarter * (kShares / 4); share < (quarter + 1) * (kShares / 4); ++share)
      sum += shares[int64_t(share) * total + at];
  partial[quarter][threadIdx.x % (kThreads / 4)] = sum;
  __syncthreads();
  if (quarter != 0 || at >= total) return;
  const int place = int(threadIdx.x);
  sum = partial[0][place] + partial[1][place] + partial[2][place] + partial[3][place];
  const int head = tiles.layers - 1, in_head = at - tiles.first_value[head], width = tiles.input_count[head];
  if (in_head < 0) {
    gradient[at] = sum;
    return;
  }
  const bool is_bias = in_head >= kDeltaColumns * width;
  const int output = head_output(is_bias ? in_head - kDeltaColumns * width : in_head / width);
  if (output < 0) return;
  gradient[tiles.first_value[head] + (is_bias ? kHeadOutputs * width + output : output * width + in_head % width)] = sum;
}

}  // namespace

void network_weight_gradient(const FieldNetwork& net, const float* features, const float* hidden, const float* v_hidden,
                             const float* v_head, float* gradient, int64_t count, CudaScratch& scratch, cudaStream_t stream) {
  LayerTiles tiles = {};
  tiles.layers = net.layers;
  for (int layer = 0; layer < net.layers; ++layer) {
    const bool head = layer == net.layers - 1;
    const int inputs = layer == 0 ? net.features : net.width, outputs = head ? kDeltaColumns : net.width;
    tiles.inputs[layer] = layer == 0 ? features : hidden + (layer - 1) * count * net.width;
    tiles.v_outputs[layer] = head ? v_head : v_hidden + layer * count * net.width;
    tiles.input_count[layer] = inputs, tiles.output_count[layer] = outputs;
    const int across = (inputs + kInputs - 1) / kInputs, down = (outputs + kOutputs - 1) / kOutputs;
    tiles.first_tile[layer + 1] = tiles.first_tile[layer] + across * down;
    tiles.first_value[layer + 1] = tiles.first_value[layer] + outputs * (inputs + 1);
  }
  const int total = tiles.first_value[net.layers];
  float* shares = scratch.array<float>(int64_t(kShares) * total);
  sum_shares<<<dim3(unsigned(tiles.first_tile[net.layers]), kShares), kTileThreads, 0, stream>>>(tiles, shares, count);
  add_shares<<<blocks_for(total, kThreads / 4), kThreads, 0, stream>>>(tiles, shares, gradient);
}
