// Gradient of the network's weights on tensor cores: outer products of the gradients of a layer's outputs and of its
// inputs, summed over Gaussians. Split-K: a block sums a tile of one layer over its share of the Gaussians; the partial
// sums are then added in a fixed order.
#include "cuda_scratch.h"
#include "matrix_units.cuh"
#include "training.h"

namespace gsplat::hexplane {
namespace {

constexpr int kTile = 64;           // outputs and inputs per block; each of its four warps has a quarter of the tile
constexpr int kPart = kTile / 2;    // outputs and inputs per warp
constexpr int kDeep = 16;           // Gaussians per pipeline stage
constexpr int kStages = 4;          // stages of the copy pipeline; the oldest one is multiplied
constexpr int kStride = kTile + 8;  // in floats; avoids bank conflicts
constexpr int kTileThreads = 128;
constexpr int kBlocks = 512;  // approximate number of resident blocks on a large GPU
constexpr int kMaxSplits = 128;

struct LayerTiles {
  const float *inputs[kMaxFieldLayers], *v_outputs[kMaxFieldLayers];    // [N, input_count], [N, output_count]
  int32_t input_count[kMaxFieldLayers], output_count[kMaxFieldLayers];  // padded
  int32_t first_tile[kMaxFieldLayers + 1];
  int32_t first_value[kMaxFieldLayers + 1];  // start of each layer in a partial sum: weights [outputs, inputs], then biases
  int32_t layers, splits;

  __device__ int layer_of(const int32_t (&first)[kMaxFieldLayers + 1], int at) const {
    int layer = 0;
    while (at >= first[layer + 1]) ++layer;
    return layer;
  }
};

struct Stage {
  float v[kDeep][kStride], x[kDeep][kStride];
};

// Four consecutive columns of the lane's Gaussians `quad` and `quad + 4` of eight. The assignment of outputs and inputs
// to rows and columns of the product is arbitrary, so these 16 bytes are operands of four products.
struct Operand {
  float v[2][4];

  __device__ Operand(const float (&rows)[kDeep][kStride], int row, int column) {
#pragma unroll
    for (int k = 0; k < 2; ++k) {
      const float4 x = *reinterpret_cast<const float4*>(&rows[row + 4 * k][column]);
      v[k][0] = x.x, v[k][1] = x.y, v[k][2] = x.z, v[k][3] = x.w;
    }
  }
};

__global__ void __launch_bounds__(kTileThreads, 4) partial_sums(LayerTiles tiles, float* __restrict__ partials, int64_t count) {
  __shared__ __align__(16) Stage stages[kStages];
  const int layer = tiles.layer_of(tiles.first_tile, int(blockIdx.x)), tile = int(blockIdx.x) - tiles.first_tile[layer];
  const int inputs = tiles.input_count[layer], outputs = tiles.output_count[layer], across = (inputs + kTile - 1) / kTile;
  const int first_output = tile / across * kTile, first_input = tile % across * kTile;
  const int64_t begin = count * blockIdx.y / tiles.splits, end = count * (blockIdx.y + 1) / tiles.splits;
  const int steps = int((end - begin + kDeep - 1) / kDeep);

  // A thread copies 16 bytes of some rows, and zeros past the end.
  constexpr int kPieces = kTile / 4, kRows = kTileThreads / kPieces;
  const int row = int(threadIdx.x) / kPieces, column = int(threadIdx.x) % kPieces * 4;
  const bool has_v = first_output + column < outputs, has_x = first_input + column < inputs;
  const float* v_from = tiles.v_outputs[layer] + (has_v ? first_output + column : 0);
  const float* x_from = tiles.inputs[layer] + (has_x ? first_input + column : 0);
  const auto copy = [&](int step) {
    Stage& to = stages[step % kStages];
#pragma unroll
    for (int r = row; r < kDeep; r += kRows) {
      const int64_t at = begin + int64_t(step) * kDeep + r, inside = at < end ? at : begin;
      copy_16(&to.v[r][column], v_from + inside * outputs, has_v && at < end);
      copy_16(&to.x[r][column], x_from + inside * inputs, has_x && at < end);
    }
  };

  const WarpPlace place;
  const int warp = int(threadIdx.x) / 32, output = warp / 2 * kPart, input = warp % 2 * kPart;
  const bool idle = first_output + output >= outputs || first_input + input >= inputs;
  float sums[2][4][4] = {}, bias[4] = {};
#pragma unroll
  for (int step = 0; step < kStages - 1; ++step) {
    if (step < steps) copy(step);
    commit_copies();
  }
  for (int step = 0; step < steps; ++step) {
    wait_for_copies<kStages - 2>();
    __syncthreads();  // the copies of all threads have arrived, and no thread reads the previous stage
    if (step + kStages - 1 < steps) copy(step + kStages - 1);
    commit_copies();
    if (idle) continue;
    const Stage& stage = stages[step % kStages];
#pragma unroll
    for (int k = 0; k < kDeep; k += 8) {
      const Operand v(stage.v, k + place.quad, output + 4 * place.group), x(stage.x, k + place.quad, input + 4 * place.group);
#pragma unroll
      for (int m = 0; m < 2; ++m) {
        const SplitLeft a(v.v[0][2 * m], v.v[0][2 * m + 1], v.v[1][2 * m], v.v[1][2 * m + 1]);
#pragma unroll
        for (int t = 0; t < 4; ++t) multiply_split(sums[m][t], a, x.v[0][t], x.v[1][t]);
      }
#pragma unroll
      for (int i = 0; i < 4; ++i) bias[i] += v.v[0][i] + v.v[1][i];
    }
  }
  if (idle) return;

  float* to = partials + int64_t(blockIdx.y) * tiles.first_value[tiles.layers] + tiles.first_value[layer];
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    const int lane_output = first_output + output + 4 * place.group + i;
    bias[i] += __shfl_xor_sync(0xffffffffu, bias[i], 1);
    bias[i] += __shfl_xor_sync(0xffffffffu, bias[i], 2);
    if (lane_output >= outputs) continue;
    if (first_input + input == 0 && place.quad == 0) to[outputs * inputs + lane_output] = bias[i];
#pragma unroll
    for (int k = 0; k < 2; ++k) {
      const int at = first_input + input + 8 * place.quad + 4 * k, c = i % 2 * 2 + k;
      const auto& sum = sums[i / 2];
      if (at < inputs)
        *reinterpret_cast<float4*>(to + lane_output * inputs + at) = make_float4(sum[0][c], sum[1][c], sum[2][c], sum[3][c]);
    }
  }
}

// Index in the gradient of value `at` of a partial sum, or -1 for padding.
__device__ int place_in_gradient(const FieldNetwork& net, const LayerTiles& tiles, int at) {
  const int layer = tiles.layer_of(tiles.first_value, at);
  at -= tiles.first_value[layer];
  const int stride = tiles.input_count[layer], weights = tiles.output_count[layer] * stride;
  const bool is_bias = at >= weights, head = layer == net.layers - 1;
  const int row = is_bias ? at - weights : at / stride, input = is_bias ? 0 : at % stride;
  const int inputs = layer == 0 ? net.features : net.width, outputs = head ? kHeadOutputs : net.width;
  const int output = head ? head_output(row) : row;
  if (output < 0 || output >= outputs || input >= inputs) return -1;
  const int start = layer == 0 ? 0 : net.width * (net.features + 1 + (layer - 1) * (net.width + 1));
  return start + (is_bias ? outputs * inputs + output : output * inputs + input);
}

__global__ void __launch_bounds__(kThreads)
    reduce_partials(FieldNetwork net, LayerTiles tiles, const float* __restrict__ partials, float* gradient) {
  constexpr int kParts = 4, kValues = kThreads / kParts;
  __shared__ float partial[kParts][kValues];
  const int value = int(threadIdx.x) % kValues, part = int(threadIdx.x) / kValues;
  const int at = int(blockIdx.x) * kValues + value, total = tiles.first_value[tiles.layers];
  float sum = 0.0f;
  if (at < total)
#pragma unroll 8
    for (int split = part; split < tiles.splits; split += kParts) sum += partials[int64_t(split) * total + at];
  partial[part][value] = sum;
  __syncthreads();
  if (part != 0 || at >= total) return;
  const int place = place_in_gradient(net, tiles, at);
  if (place >= 0) gradient[place] = partial[0][value] + partial[1][value] + partial[2][value] + partial[3][value];
}

}  // namespace

void network_weight_gradient(const FieldNetwork& net, const float* features, const float* hidden, const float* v_hidden,
                             const float* v_head, float* gradient, int64_t count, CudaScratch& scratch, cudaStream_t stream) {
  LayerTiles tiles = {};
  tiles.layers = net.layers;
  const int width = net.padded_width();
  for (int layer = 0; layer < net.layers; ++layer) {
    const bool head = layer == net.layers - 1;
    const int inputs = layer == 0 ? net.features : width, outputs = head ? kRawColumns : width;
    tiles.inputs[layer] = layer == 0 ? features : hidden + (layer - 1) * count * width;
    tiles.v_outputs[layer] = head ? v_head : v_hidden + layer * count * width;
    tiles.input_count[layer] = inputs, tiles.output_count[layer] = outputs;
    tiles.first_tile[layer + 1] = tiles.first_tile[layer] + int32_t(blocks_for(inputs, kTile) * blocks_for(outputs, kTile));
    tiles.first_value[layer + 1] = tiles.first_value[layer] + outputs * (inputs + 1);
  }
  const int total = tiles.first_value[net.layers];
  const int blocks = tiles.first_tile[net.layers];
  tiles.splits = blocks * kMaxSplits < kBlocks ? kMaxSplits : (kBlocks + blocks - 1) / blocks;
  float* partials = scratch.array<float>(int64_t(tiles.splits) * total);
  partial_sums<<<dim3(unsigned(blocks), unsigned(tiles.splits)), kTileThreads, 0, stream>>>(tiles, partials, count);
  reduce_partials<<<blocks_for(total, kThreads / 4), kThreads, 0, stream>>>(net, tiles, partials, gradient);
}

}  // namespace gsplat::hexplane
