// The way back through the network: gradients of the layers' sums and of the features, on the matrix units as the way forward.
#include "matrix_units.cuh"
#include "network_cuda.h"
#include "training_cuda.h"

namespace {

constexpr int kRowsPerWarp = 16;
constexpr int kRowsPerBlock = kRowsPerWarp * kThreads / 32;

// Weights as [outputs, inputs] with 4 floats between rows: the lanes of a warp, 4 rows and 8 columns, meet in no bank.
struct BackwardLayout {
  int width, features;  // padded
  __device__ __host__ explicit BackwardLayout(const FieldNetwork& net)
      : width(net.padded_width()), features((net.features + 31) / 32 * 32) {}
  __device__ __host__ int first_stride() const { return features + 4; }
  __device__ __host__ int hidden_stride() const { return width + 4; }
  __device__ __host__ int start(int layer) const {
    return layer == 0 ? 0 : width * (first_stride() + (layer - 1) * hidden_stride());
  }
  __device__ __host__ int floats(int layers) const { return start(layers - 1) + 16 * hidden_stride(); }
};

__global__ void __launch_bounds__(kThreads) pack_weights(FieldNetwork net, float* packed) {
  const BackwardLayout layout(net);
  const int layer = int(blockIdx.y);
  const bool head = layer == net.layers - 1;
  const int columns = layer == 0 ? layout.features : layout.width, inputs = layer == 0 ? net.features : net.width;
  const int stride = columns + 4, rows = head ? 16 : layout.width;
  for (int i = int(blockIdx.x) * kThreads + int(threadIdx.x); i < rows * stride; i += int(gridDim.x) * kThreads) {
    const int row = i / stride, column = i % stride, output = head ? head_output(row) : row;
    const bool inside = output >= 0 && (head || output < net.width) && column < inputs;
    packed[layout.start(layer) + i] = inside ? net.weights[layer][output * inputs + column] : 0.0f;
  }
}

// sums[j] = in W for column block first + j of W's inputs; `in` as the sums of a product lie in the registers.
template <int kIn, int kOut>
__device__ __forceinline__ void previous_layer(const float (&in)[kIn][4], float (&sums)[kOut][4], const float* w, int stride,
                                               const WarpPlace& place) {
#pragma unroll
  for (int k = 0; k < kIn; ++k) {
    const SplitLeft a(in[k][0], in[k][2], in[k][1], in[k][3]);
    const float* row = w + (8 * k + 2 * place.quad) * stride + place.group;
#pragma unroll
    for (int t = 0; t < kOut; ++t) multiply_split(sums[t], a, row[8 * t], row[stride + 8 * t]);
  }
}

template <int kWidth>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(FieldNetwork net, const uint4* __restrict__ packed, const float* __restrict__ v_raw,
                    const float* __restrict__ hidden, float* __restrict__ v_features, float* __restrict__ v_hidden,
                    float* __restrict__ v_head, int64_t count) {
  extern __shared__ uint4 shared[];
  const float* weights = reinterpret_cast<const float*>(shared);
  constexpr int kBlocks = kWidth / 8, kColumnBlocks = 4;
  const BackwardLayout layout(net);
  for (int i = int(threadIdx.x); i < layout.floats(net.layers) / 4; i += kThreads) copy_16(shared + i, packed + i);
  wait_for_copies();
  __syncthreads();
  const WarpPlace place;
  const int64_t first = int64_t(blockIdx.x) * kRowsPerBlock + threadIdx.x / 32 * kRowsPerWarp;
  if (first >= count) return;
  const int64_t rows[2] = {first + place.group, first + place.group + 8};

  float head[2][4];
#pragma unroll
  for (int r = 0; r < 2; ++r) {
    const bool inside = rows[r] < count;
    float2 v[2] = {};
    bool finite = true;
    for (int t = 0; t < 2 && inside; ++t) {
      v[t] = *reinterpret_cast<const float2*>(v_raw + rows[r] * kDeltaColumns + 8 * t + 2 * place.quad);
      finite = finite && isfinite(v[t].x) && isfinite(v[t].y);
    }
    const unsigned team = 0xfu << (place.group * 4);  // the four lanes of the row
    finite = __all_sync(team, finite);
    for (int t = 0; t < 2; ++t) {
      const int column = 8 * t + 2 * place.quad;
      head[t][2 * r] = finite && head_output(column) >= 0 ? v[t].x : 0.0f;
      head[t][2 * r + 1] = finite && head_output(column + 1) >= 0 ? v[t].y : 0.0f;
      if (inside)
        *reinterpret_cast<float2*>(v_head + rows[r] * kDeltaColumns + column) = make_float2(head[t][2 * r], head[t][2 * r + 1]);
    }
  }

  float now[kBlocks][4];
  for (int layer = net.layers - 1; layer >= 1; --layer) {
    float sums[kBlocks][4] = {};
    const float* w = weights + layout.start(layer);
    if (layer == net.layers - 1) {
      previous_layer(head, sums, w, layout.hidden_stride(), place);
    } else {
      previous_layer(now, sums, w, layout.hidden_stride(), place);
    }
#pragma unroll
    for (int t = 0; t < kBlocks; ++t)
#pragma unroll
      for (int i = 0; i < 4; ++i) {
        const int column = 8 * t + 2 * place.quad + i % 2;
        const bool inside = rows[i / 2] < count && column < net.width;
        const int64_t at = ((layer - 1) * count + rows[i / 2]) * net.width + column;
        now[t][i] = inside && hidden[at] > 0.0f ? sums[t][i] : 0.0f;
        if (inside) v_hidden[at] = now[t][i];
      }
  }
  for (int column = 0; column < net.features; column += 8 * kColumnBlocks) {
    float sums[kColumnBlocks][4] = {};
    previous_layer(now, sums, weights + column, layout.first_stride(), place);
#pragma unroll
    for (int t = 0; t < kColumnBlocks; ++t)
      for (int r = 0; r < 2; ++r) {
        const int at = column + 8 * t + 2 * place.quad;
        if (rows[r] < count && at < net.features)
          *reinterpret_cast<float2*>(v_features + rows[r] * net.features + at) = make_float2(sums[t][2 * r], sums[t][2 * r + 1]);
      }
  }
}

template <int kWidth>
void launch(const FieldNetwork& net, const float* v_raw, const float* hidden, float* v_features, float* v_hidden, float* v_head,
            int64_t count, CudaScratch& scratch, cudaStream_t stream) {
  const int bytes = BackwardLayout(net).floats(net.layers) * int(sizeof(float));
  cudaFuncSetAttribute(backward_kernel<kWidth>, cudaFuncAttributeMaxDynamicSharedMemorySize, bytes);
  float* packed = scratch.array<float>(BackwardLayout(net).floats(net.layers));
  pack_weights<<<dim3(16, unsigned(net.layers)), kThreads, 0, stream>>>(net, packed);
  backward_kernel<kWidth><<<blocks_for(count, kRowsPerBlock), kThreads, bytes, stream>>>(
      net, reinterpret_cast<const uint4*>(packed), v_raw, hidden, v_features, v_hidden, v_head, count);
}

}  // namespace

void network_backward(const FieldNetwork& net, const float* v_raw, const float* hidden, float* v_features, float* v_hidden,
                      float* v_head, int64_t count, CudaScratch& scratch, cudaStream_t stream) {
  if (count == 0) return;
  switch (net.padded_width()) {
    case 32: return launch<32>(net, v_raw, hidden, v_features, v_hidden, v_head, count, scratch, stream);
    case 64: return launch<64>(net, v_raw, hidden, v_features, v_hidden, v_head, count, scratch, stream);
    default: return launch<128>(net, v_raw, hidden, v_features, v_hidden, v_head, count, scratch, stream);
  }
}
