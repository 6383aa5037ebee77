// Backward pass of the network on tensor cores: gradients of the layers' pre-activations and of the features.
//
// The assignment of a layer's columns to columns of the product is arbitrary. Here a lane has four consecutive columns
// of each row, at 16 half + 4 quad of 32 columns, so that all its accesses are 16 bytes wide.
#include "cuda_check.h"
#include "cuda_scratch.h"
#include "matrix_units.cuh"
#include "training.h"

namespace gsplat::hexplane {
namespace {

constexpr int kRowsPerWarp = 16;
constexpr int kRowsPerBlock = kRowsPerWarp * kThreads / 32;
constexpr int kFeatureColumns = 64;  // feature columns that a warp computes at once

// Weights [outputs, inputs] with rows padded by 4 floats; within every 16 rows, row 4 a + b is stored at 4 b + a. The
// quads of a warp read rows 4 apart, and this layout avoids bank conflicts.
struct BackwardLayout {
  int width, features;  // padded
  __device__ __host__ explicit BackwardLayout(const FieldNetwork& net)
      : width(net.padded_width()), features((net.features + kFeatureColumns - 1) / kFeatureColumns * kFeatureColumns) {}
  __device__ __host__ int first_stride() const { return features + 4; }
  __device__ __host__ int hidden_stride() const { return width + 4; }
  __device__ __host__ int start(int layer) const {
    return layer == 0 ? 0 : width * (first_stride() + (layer - 1) * hidden_stride());
  }
  __device__ __host__ int floats(int layers) const { return start(layers - 1) + kRawColumns * hidden_stride(); }
};

__global__ void __launch_bounds__(kThreads) pack_weights(FieldNetwork net, float* packed) {
  const BackwardLayout layout(net);
  const int layer = int(blockIdx.y);
  const bool is_head = layer == net.layers - 1;
  const int columns = layer == 0 ? layout.features : layout.width, inputs = layer == 0 ? net.features : net.width;
  const int stride = columns + 4, places = is_head ? kRawColumns : layout.width;
  for (int i = int(blockIdx.x) * kThreads + int(threadIdx.x); i < places * stride; i += int(gridDim.x) * kThreads) {
    const int place = i / stride, column = i % stride, row = place / 16 * 16 + place % 4 * 4 + place % 16 / 4;
    const int output = is_head ? head_output(row) : row;
    const bool inside = output >= 0 && (is_head || output < net.width) && column < inputs;
    packed[layout.start(layer) + i] = inside ? net.weights[layer][output * inputs + column] : 0.0f;
  }
}

// Accumulators of a product of 16 rows and 32 columns.
struct Columns {
  float sums[4][4];  // [t][2 r + half]: row group + 8 r, column 16 half + 4 quad + t

  __device__ float4 at(int r, int half) const {
    return make_float4(sums[0][2 * r + half], sums[1][2 * r + half], sums[2][2 * r + half], sums[3][2 * r + half]);
  }
  // Set the gradient to zero where ReLU's `outputs` at the same positions are zero.
  __device__ void rectify(int r, int half, const float4& outputs) {
    const float out[4] = {outputs.x, outputs.y, outputs.z, outputs.w};
#pragma unroll
    for (int t = 0; t < 4; ++t) sums[t][2 * r + half] = out[t] > 0.0f ? sums[t][2 * r + half] : 0.0f;
  }
};

// Add `a` times the weight rows at `first` and `second` to the accumulators `out`.
template <int kOut>
__device__ __forceinline__ void multiply_rows(Columns (&out)[kOut], const SplitLeft& a, const float* first, const float* second) {
#pragma unroll
  for (int b = 0; b < kOut; ++b) {
    const float4 w0 = *reinterpret_cast<const float4*>(first + 32 * b), w1 = *reinterpret_cast<const float4*>(second + 32 * b);
    multiply_split(out[b].sums[0], a, w0.x, w1.x);
    multiply_split(out[b].sums[1], a, w0.y, w1.y);
    multiply_split(out[b].sums[2], a, w0.z, w1.z);
    multiply_split(out[b].sums[3], a, w0.w, w1.w);
  }
}

// out += in W for 32 of the weight rows. `w` points to the lane's columns of the quad's first row.
template <int kOut>
__device__ __forceinline__ void multiply_columns(Columns (&out)[kOut], const Columns& in, const float* w, int stride) {
#pragma unroll
  for (int t = 0; t < 4; ++t) {
    const auto& x = in.sums[t];
    multiply_rows(out, SplitLeft(x[0], x[2], x[1], x[3]), w + 4 * t * stride, w + (4 * t + 16) * stride);
  }
}

// Load four columns of a row of v_raw. Non-finite rows and columns that do not belong to the field are zero.
__device__ __forceinline__ float4 head_gradient(const float* v_raw, int64_t row, bool inside, const WarpPlace& place) {
  const int column = 4 * place.quad;
  const float4 v = inside ? *reinterpret_cast<const float4*>(v_raw + row * kRawColumns + column) : float4{};
  const unsigned team = 0xfu << (place.group * 4);  // the row's four lanes
  const bool finite = __all_sync(team, isfinite(v.x) && isfinite(v.y) && isfinite(v.z) && isfinite(v.w));
  const auto own = [&](int i, float x) { return finite && head_output(column + i) >= 0 ? x : 0.0f; };
  return make_float4(own(0, v.x), own(1, v.y), own(2, v.z), own(3, v.w));
}

template <int kWidth>
__global__ void __launch_bounds__(kThreads, kWidth == 128 ? 1 : 2)
    backward_kernel(FieldNetwork net, const uint4* __restrict__ packed, const float* __restrict__ v_raw,
                    const float* __restrict__ hidden, float* __restrict__ v_features, float* __restrict__ v_hidden,
                    float* __restrict__ v_head, int64_t count) {
  extern __shared__ uint4 shared[];
  constexpr int kBlocks = kWidth / 32;
  const BackwardLayout layout(net);
  for (int i = int(threadIdx.x); i < layout.floats(net.layers) / 4; i += kThreads) copy_16(shared + i, packed + i);
  wait_for_copies();
  __syncthreads();
  const WarpPlace place;
  const int64_t first = int64_t(blockIdx.x) * kRowsPerBlock + threadIdx.x / 32 * kRowsPerWarp;
  if (first >= count) return;
  const int64_t rows[2] = {first + place.group, first + place.group + 8};
  const float* weights = reinterpret_cast<const float*>(shared) + 4 * (place.group / 2) + 16 * (place.group % 2);

  float4 head[2];
#pragma unroll
  for (int r = 0; r < 2; ++r) {
    head[r] = head_gradient(v_raw, rows[r], rows[r] < count, place);
    if (rows[r] < count) *reinterpret_cast<float4*>(v_head + rows[r] * kRawColumns + 4 * place.quad) = head[r];
  }
  Columns now[kBlocks];
  for (int layer = net.layers - 1; layer >= 1; --layer) {
    const int64_t start = (layer - 1) * count;  // start of the previous layer
    const int stride = layout.hidden_stride();
    const float* w = weights + layout.start(layer) + place.quad * stride;
    Columns before[kBlocks] = {};
    if (layer == net.layers - 1) {
      multiply_rows(before, SplitLeft(head[0].x, head[1].x, head[0].y, head[1].y), w, w + 4 * stride);
      multiply_rows(before, SplitLeft(head[0].z, head[1].z, head[0].w, head[1].w), w + 8 * stride, w + 12 * stride);
    } else {
#pragma unroll
      for (int b = 0; b < kBlocks - 1; ++b) multiply_columns(before, now[b], w + 32 * b * stride, stride);
    }
    float4 outputs[kBlocks][2][2];  // loaded before the last products; rows past the end read the last row
#pragma unroll
    for (int r = 0; r < 2; ++r) {
      const float* row = hidden + (start + (rows[r] < count ? rows[r] : count - 1)) * kWidth + 4 * place.quad;
#pragma unroll
      for (int i = 0; i < 2 * kBlocks; ++i) outputs[i / 2][r][i % 2] = *reinterpret_cast<const float4*>(row + 16 * i);
    }
    if (layer < net.layers - 1) multiply_columns(before, now[kBlocks - 1], w + 32 * (kBlocks - 1) * stride, stride);
#pragma unroll
    for (int r = 0; r < 2; ++r) {
      float* row = v_hidden + (start + rows[r]) * kWidth + 4 * place.quad;
#pragma unroll
      for (int i = 0; i < 2 * kBlocks; ++i) {
        before[i / 2].rectify(r, i % 2, outputs[i / 2][r][i % 2]);
        if (rows[r] < count) *reinterpret_cast<float4*>(row + 16 * i) = before[i / 2].at(r, i % 2);
      }
    }
#pragma unroll
    for (int b = 0; b < kBlocks; ++b) now[b] = before[b];
  }
  for (int first_column = 0; first_column < net.features; first_column += kFeatureColumns) {
    Columns out[kFeatureColumns / 32] = {};
#pragma unroll
    for (int b = 0; b < kBlocks; ++b)
      multiply_columns(out, now[b], weights + first_column + (32 * b + place.quad) * layout.first_stride(),
                       layout.first_stride());
#pragma unroll
    for (int r = 0; r < 2; ++r)
#pragma unroll
      for (int i = 0; i < kFeatureColumns / 16; ++i) {
        const int column = first_column + 16 * i + 4 * place.quad;
        if (rows[r] < count && column < net.features)
          *reinterpret_cast<float4*>(v_features + rows[r] * net.features + column) = out[i / 2].at(r, i % 2);
      }
  }
}

template <int kWidth>
void launch(const FieldNetwork& net, const float* v_raw, const float* hidden, float* v_features, float* v_hidden, float* v_head,
            int64_t count, CudaScratch& scratch, cudaStream_t stream) {
  const int bytes = BackwardLayout(net).floats(net.layers) * int(sizeof(float));
  check_cuda(cudaFuncSetAttribute(backward_kernel<kWidth>, cudaFuncAttributeMaxDynamicSharedMemorySize, bytes),
             "reserving shared memory");
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

}  // namespace gsplat::hexplane
