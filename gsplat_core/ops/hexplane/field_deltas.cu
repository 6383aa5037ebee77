// Features in the order in which the matrix units want them: four lanes share a Gaussian and take 16 bytes each of 64 bytes of
// its features, so that loads are wide and nothing is exchanged between lanes. A warp has 16 Gaussians.
#include <cuda_fp16.h>

#include "line_position.h"
#include "matrix_units.cuh"
#include "network_cuda.h"

using namespace GSPLAT_ISA;

namespace {

constexpr int kRowsPerWarp = 16;
constexpr int kWarps = 4;  // of a block
constexpr int kRowsPerBlock = kRowsPerWarp * kWarps;

// 16 bytes of features, and what is done to all of them.
template <class T>
struct Piece;

template <>
struct Piece<float> {
  float v[4];
  __device__ static Piece load(const float* p) {
    const float4 x = *reinterpret_cast<const float4*>(p);
    return {{x.x, x.y, x.z, x.w}};
  }
  __device__ void modulate(const Piece& a, const Piece& b, float fraction) {
#pragma unroll
    for (int i = 0; i < 4; ++i) v[i] *= a.v[i] + fraction * (b.v[i] - a.v[i]);
  }
};

template <>
struct Piece<__half> {
  __half2 v[4];
  __device__ static Piece load(const __half* p) {
    const uint4 x = *reinterpret_cast<const uint4*>(p);
    Piece out;
    *reinterpret_cast<uint4*>(out.v) = x;
    return out;
  }
  __device__ void modulate(const Piece& a, const Piece& b, float fraction) {
    const __half2 f = __float2half2_rn(fraction);
#pragma unroll
    for (int i = 0; i < 4; ++i) v[i] = __hmul2(v[i], __hfma2(f, __hsub2(b.v[i], a.v[i]), a.v[i]));
  }
};

__device__ __forceinline__ uint32_t bits_of(__half2 x) { return *reinterpret_cast<uint32_t*>(&x); }

// sums[t] += the pieces of two rows times the first layer's weights; `w` points to the lane's place in the row of block 0.
template <int kBlocks>
__device__ __forceinline__ void first_layer(float (&sums)[kBlocks][4], const Piece<__half> (&x)[2], const __half* w, int stride) {
  const uint32_t a0[4] = {bits_of(x[0].v[0]), bits_of(x[1].v[0]), bits_of(x[0].v[1]), bits_of(x[1].v[1])};
  const uint32_t a1[4] = {bits_of(x[0].v[2]), bits_of(x[1].v[2]), bits_of(x[0].v[3]), bits_of(x[1].v[3])};
#pragma unroll
  for (int t = 0; t < kBlocks; ++t) {
    const uint4 b = *reinterpret_cast<const uint4*>(w + t * 8 * stride);
    multiply_half(sums[t], a0, b.x, b.y);
    multiply_half(sums[t], a1, b.z, b.w);
  }
}

template <int kBlocks>
__device__ __forceinline__ void first_layer(float (&sums)[kBlocks][4], const Piece<float> (&x)[2], const float* w, int stride) {
  const SplitLeft a0(x[0].v[0], x[1].v[0], x[0].v[1], x[1].v[1]), a1(x[0].v[2], x[1].v[2], x[0].v[3], x[1].v[3]);
#pragma unroll
  for (int t = 0; t < kBlocks; ++t) {
    const float4 b = *reinterpret_cast<const float4*>(w + t * 8 * stride);
    multiply_split(sums[t], a0, b.x, b.y);
    multiply_split(sums[t], a1, b.z, b.w);
  }
}

// The next layer: its inputs are the sums of the layer before, as they lie in the registers.
template <int kIn, int kOut>
__device__ __forceinline__ void next_layer(const float (&in)[kIn][4], float (&sums)[kOut][4], const __half* w, int stride) {
#pragma unroll
  for (int k = 0; k < kIn; k += 2) {
    const uint32_t a[4] = {pack_halves(in[k][0], in[k][1]), pack_halves(in[k][2], in[k][3]),
                           pack_halves(in[k + 1][0], in[k + 1][1]), pack_halves(in[k + 1][2], in[k + 1][3])};
#pragma unroll
    for (int t = 0; t < kOut; ++t) {
      const uint2 b = *reinterpret_cast<const uint2*>(w + t * 8 * stride + k * 8);
      multiply_half(sums[t], a, b.x, b.y);
    }
  }
}

template <int kIn, int kOut>
__device__ __forceinline__ void next_layer(const float (&in)[kIn][4], float (&sums)[kOut][4], const float* w, int stride) {
#pragma unroll
  for (int k = 0; k < kIn; ++k) {
    const SplitLeft a(in[k][0], in[k][2], in[k][1], in[k][3]);
#pragma unroll
    for (int t = 0; t < kOut; ++t) {
      const float2 b = *reinterpret_cast<const float2*>(w + t * 8 * stride + k * 8);
      multiply_split(sums[t], a, b.x, b.y);
    }
  }
}

template <int kBlocks>
__device__ __forceinline__ void start_with_bias(float (&sums)[kBlocks][4], const float* bias, int quad) {
#pragma unroll
  for (int t = 0; t < kBlocks; ++t) {
    sums[t][0] = sums[t][2] = bias[8 * t + 2 * quad];
    sums[t][1] = sums[t][3] = bias[8 * t + 2 * quad + 1];
  }
}

// Where a lane's two rows fall on the three lines of a level. Each of the four lanes of a row works out one axis and tells the
// others.
struct LinePlaces {
  int offset[2][3];  // of the left node, in items
  float fraction[2][3];

  // x: the coordinates of the rows along axis `quad`
  __device__ LinePlaces(const FieldLines& lines, int level, const float (&x)[2], const WarpPlace& place, int channels) {
    const int32_t* widths = lines.widths[level];
    const int32_t width = place.quad == 0 ? widths[0] : place.quad == 1 ? widths[1] : widths[2];
#pragma unroll
    for (int r = 0; r < 2; ++r) {
      const LinePosition at = position_on(x[r], width);
      const int own = int(at.cell) * channels;
#pragma unroll
      for (int axis = 0; axis < 3; ++axis) {
        offset[r][axis] = __shfl_sync(0xffffffffu, own, 4 * place.group + axis);
        fraction[r][axis] = __shfl_sync(0xffffffffu, at.fraction, 4 * place.group + axis);
      }
    }
  }
};

template <class T>
__device__ __forceinline__ void swap_pieces(Piece<T>& a, Piece<T>& b, bool swap) {
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    const auto x = a.v[i], y = b.v[i];
    a.v[i] = swap ? y : x;
    b.v[i] = swap ? x : y;
  }
}

// Blocks that a multiprocessor should hold at once, by the registers that the layers need.
constexpr int blocks_of(int item, int width) { return width == 32 ? (item == 2 ? 6 : 4) : width == 64 ? 4 : 2; }

// kChannels: channels where they are known and every line has two nodes or more; 0: read from the input.
template <class T, int kWidth, bool kLines, int kChannels>
__global__ void __launch_bounds__(32 * kWarps, blocks_of(int(sizeof(T)), kWidth))
    deltas_kernel(FieldInput in, FieldNetwork net, const void* packed, float* deltas, float* hidden) {
  extern __shared__ uint4 shared[];
  constexpr int kItem = int(sizeof(T)), kPiece = 16 / kItem, kQuad = 4 * kPiece, kBlocks = kWidth / 8;
  constexpr int kParts = kChannels * kItem % 128 == 0 && kChannels > 0 ? 2 : 1;  // of 64 bytes that are loaded together
  for (int i = int(threadIdx.x); i < int(net.packed_bytes(kItem) / 16); i += 32 * kWarps)
    copy_16(shared + i, static_cast<const uint4*>(packed) + i);
  const T* weights = reinterpret_cast<const T*>(shared);
  const float* biases = reinterpret_cast<const float*>(weights + net.weight_items(kItem));
  const WarpPlace place;
  const int channels = kChannels > 0 ? kChannels : in.channels;
  const int count = int(in.count), first = int(blockIdx.x) * kRowsPerBlock + int(threadIdx.x) / 32 * kRowsPerWarp;
  int rows[2];
  float x[2] = {};
  for (int r = 0; r < 2; ++r) {
    rows[r] = first + place.group + 8 * r;
    if (kLines && rows[r] < count) x[r] = in.coordinates[int64_t(4) * rows[r] + min(place.quad, 2)];
  }
  wait_for_copies();
  __syncthreads();
  if (first >= count) return;

  float sums[kBlocks][4];
  start_with_bias(sums, biases, place.quad);
  const int stride = net.first_stride(kItem);
  const T* w = weights + place.group * stride + place.quad * kPiece;
  // Rows of 128 bytes: neighbouring rows start with different halves, so that the lanes that load together meet in no bank.
  const int odd = kParts == 2 ? place.group % 2 : 0;
  const int lane_at = place.quad * kPiece;
  for (int level = 0; level < in.levels; ++level) {
    const T *left[2][3] = {}, *space[2];
    float fraction[2][3] = {};
    int right[3] = {kChannels, kChannels, kChannels};
    for (int r = 0; r < 2; ++r)
      space[r] = static_cast<const T*>(in.spaces[level]) + int64_t(min(rows[r], count - 1)) * channels + lane_at + odd * kQuad;
    if constexpr (kLines) {
      const LinePlaces places(in.lines, level, x, place, channels);
#pragma unroll
      for (int axis = 0; axis < 3; ++axis) {
        const T* line = static_cast<const T*>(in.lines.values) + in.lines.starts[level][axis] + lane_at + odd * kQuad;
        if (kChannels == 0) right[axis] = in.lines.widths[level][axis] > 1 ? channels : 0;
#pragma unroll
        for (int r = 0; r < 2; ++r) left[r][axis] = line + places.offset[r][axis], fraction[r][axis] = places.fraction[r][axis];
      }
    }
    const int other = kQuad - 2 * odd * kQuad;  // from the half that a lane starts with to the other one
    constexpr int kAhead = kLines ? 1 : 4;      // without lines a turn is two loads, and several turns' are made together
#pragma unroll kAhead
    for (int c = 0; c < channels; c += kParts * kQuad, w += kParts * kQuad) {
      Piece<T> value[kParts][2];
#pragma unroll
      for (int part = 0; part < kParts; ++part)
#pragma unroll
        for (int r = 0; r < 2; ++r) {
          const int at = c + part * other;
          Piece<T>& piece = value[part][r];
          piece = Piece<T>::load(space[r] + at);
          if constexpr (kLines) {
#pragma unroll
            for (int axis = 0; axis < 3; ++axis)
              piece.modulate(Piece<T>::load(left[r][axis] + at), Piece<T>::load(left[r][axis] + at + right[axis]),
                             fraction[r][axis]);
          }
        }
      if constexpr (kParts == 2)
        for (int r = 0; r < 2; ++r) swap_pieces(value[0][r], value[1][r], odd != 0);
#pragma unroll
      for (int part = 0; part < kParts; ++part) first_layer(sums, value[part], w + part * kQuad, stride);
    }
  }

  const int hidden_stride = net.hidden_stride(kItem);
  for (int layer = 1; layer < net.layers; ++layer) {
#pragma unroll
    for (int t = 0; t < kBlocks; ++t)
#pragma unroll
      for (int i = 0; i < 4; ++i) {
        sums[t][i] = rectified(sums[t][i]);
        const int column = 8 * t + 2 * place.quad + i % 2;
        if (hidden != nullptr && rows[i / 2] < count && column < net.width)
          hidden[((layer - 1) * in.count + rows[i / 2]) * net.width + column] = sums[t][i];
      }
    const T* next = weights + net.hidden_start(layer, kItem) + place.group * hidden_stride + place.quad * (8 / kItem);
    const float* bias = biases + layer * kWidth;
    if (layer < net.layers - 1) {
      float out[kBlocks][4];
      start_with_bias(out, bias, place.quad);
      next_layer(sums, out, next, hidden_stride);
#pragma unroll
      for (int t = 0; t < kBlocks; ++t)
#pragma unroll
        for (int i = 0; i < 4; ++i) sums[t][i] = out[t][i];
      continue;
    }
    float out[2][4];
    start_with_bias(out, bias, place.quad);
    next_layer(sums, out, next, hidden_stride);
    for (int r = 0; r < 2; ++r) {
      if (rows[r] >= count) continue;
      float* to = deltas + (in.order != nullptr ? in.order[rows[r]] : rows[r]) * int64_t(kDeltaColumns) + 2 * place.quad;
      *reinterpret_cast<float2*>(to) = make_float2(out[0][2 * r], out[0][2 * r + 1]);
      *reinterpret_cast<float2*>(to + 8) = make_float2(out[1][2 * r], out[1][2 * r + 1]);
    }
  }
}

template <class T, int kWidth>
void launch(const FieldInput& in, const FieldNetwork& net, const void* packed, float* deltas, float* hidden,
            cudaStream_t stream) {
  auto kernel = deltas_kernel<T, kWidth, false, 0>;
  if (in.lines.values != nullptr) {
    bool wide = true;
    for (int level = 0; level < in.levels; ++level)
      for (const int32_t width : in.lines.widths[level]) wide = wide && width > 1;
    kernel = wide && in.channels == 64   ? deltas_kernel<T, kWidth, true, 64>
             : wide && in.channels == 32 ? deltas_kernel<T, kWidth, true, 32>
                                         : deltas_kernel<T, kWidth, true, 0>;
  }
  const int bytes = int(net.packed_bytes(int(sizeof(T))));
  cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, bytes);
  kernel<<<blocks_for(in.count, kRowsPerBlock), 32 * kWarps, bytes, stream>>>(in, net, packed, deltas, hidden);
}

template <class T>
void launch_width(const FieldInput& in, const FieldNetwork& net, const void* packed, float* deltas, float* hidden,
                  cudaStream_t stream) {
  switch (net.padded_width()) {
    case 32: return launch<T, 32>(in, net, packed, deltas, hidden, stream);
    case 64: return launch<T, 64>(in, net, packed, deltas, hidden, stream);
    default: return launch<T, 128>(in, net, packed, deltas, hidden, stream);
  }
}

}  // namespace

void field_deltas(const FieldInput& in, const FieldNetwork& net, const void* packed, bool half, float* deltas, float* hidden,
                  cudaStream_t stream) {
  if (in.count == 0) return;
  (half ? launch_width<__half> : launch_width<float>)(in, net, packed, deltas, hidden, stream);
}
