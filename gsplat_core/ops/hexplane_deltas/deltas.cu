// Features and network in one kernel. A warp processes 16 Gaussians with four lanes each. Of 64 bytes of features each
// of the four lanes loads 16, which matches the tensor cores' operand layout: loads are wide and lanes exchange
// nothing.
#include <type_traits>

#include "../hexplane/line_position.h"
#include "cuda_check.h"
#include "cuda_scratch.h"
#include "network_layers.cuh"

namespace gsplat::hexplane {
namespace {

using namespace GSPLAT_ISA::hexplane;

constexpr int kRowsPerWarp = 16;

// Positions of a row on the three lines of a level. Each of a row's four lanes computes at most one axis and shares it
// by shuffles.
struct LinePlaces {
  int offset[3];  // offset of the left node, in items
  float fraction[3];

  // own: position on the axis that this lane computes; group: the row's four lanes
  __device__ LinePlaces(const LinePosition& own, int group, int channels) {
#pragma unroll
    for (int axis = 0; axis < 3; ++axis) {
      offset[axis] = __shfl_sync(0xffffffffu, int(own.cell), 4 * group + axis) * channels;
      fraction[axis] = __shfl_sync(0xffffffffu, own.fraction, 4 * group + axis);
    }
  }
};

// Warps per block, which share the weights, and blocks per multiprocessor, limited by the registers that the layers
// need.
constexpr int warps_of(int item, int width) { return item == 2 ? 4 : width == 32 ? 12 : 8; }
constexpr int blocks_of(int item, int width) {
  return item == 2 ? (width == 32 ? 6 : width == 64 ? 4 : 2) : width == 128 ? 1 : 2;
}

// Compute the deltas of Gaussians in one kernel. kLines: multiply the features by the time planes, read from in.lines;
// otherwise the features are complete. kChannels: number of channels if known at compile time and every line has at
// least two nodes; 0: read from the input.
template <class T, int kWidth, bool kLines, int kChannels>
__global__ void __launch_bounds__(32 * warps_of(int(sizeof(T)), kWidth), blocks_of(int(sizeof(T)), kWidth))
    deltas_kernel(FieldInput in, FieldNetwork net, const void* packed, float* deltas, float* hidden) {
  extern __shared__ uint4 shared[];
  constexpr int kItem = int(sizeof(T)), kPiece = 16 / kItem, kQuad = 4 * kPiece, kBlocks = kWidth / 8;
  constexpr int kWarps = warps_of(kItem, kWidth);
  constexpr int kParts = kChannels * kItem % 128 == 0 && kChannels > 0 ? 2 : 1;  // pieces of 64 bytes loaded together
  for (int i = int(threadIdx.x); i < int(net.packed_bytes(kItem) / 16); i += 32 * kWarps)
    copy_16(shared + i, static_cast<const uint4*>(packed) + i);
  const T* weights = reinterpret_cast<const T*>(shared);
  const float* biases = reinterpret_cast<const float*>(weights + net.weight_items(kItem));
  const WarpPlace place;
  const int channels = kChannels > 0 ? kChannels : in.channels;
  const int count = int(in.count), first = (int(blockIdx.x) * kWarps + int(threadIdx.x) / 32) * kRowsPerWarp;
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
  // If rows are multiples of 128 bytes, the eight lanes of two adjacent rows load 128 bytes of one row, then of the
  // other, and exchange halves. A load then touches 4 cache lines instead of 8, which is the limit of this kernel.
  const int odd = kParts == 2 ? place.group % 2 : 0;
  const int lane_at = place.quad * kPiece + odd * kQuad;
  for (int level = 0; level < in.levels; ++level) {
    const T* space[2][kParts];
    int left[2][kParts][3] = {};
    float fraction[2][kParts][3] = {};
    int right[3] = {kChannels, kChannels, kChannels};
    const int32_t* widths = in.lines.widths[level];
    const int32_t width = place.quad == 0 ? widths[0] : place.quad == 1 ? widths[1] : widths[2];
#pragma unroll
    for (int r = 0; r < 2; ++r) {
      const LinePosition own = kLines ? position_on(x[r], width) : LinePosition{};
#pragma unroll
      for (int row = 0; row < kParts; ++row) {
        const int group = kParts == 2 ? place.group / 2 * 2 + row : place.group;
        space[r][row] =
            static_cast<const T*>(in.spaces[level]) + int64_t(min(first + group + 8 * r, count - 1)) * channels + lane_at;
        if constexpr (kLines) {
          const LinePlaces places(own, group, channels);
#pragma unroll
          for (int axis = 0; axis < 3; ++axis) {
            if (kChannels == 0) right[axis] = widths[axis] > 1 ? channels : 0;
            left[r][row][axis] = places.offset[axis] + lane_at, fraction[r][row][axis] = places.fraction[axis];
          }
        }
      }
    }
    constexpr int kAhead = kLines ? 1 : 4;  // without lines an iteration has only two loads: unroll to keep more in flight
#pragma unroll kAhead
    for (int c = 0; c < channels; c += kParts * kQuad, w += kParts * kQuad) {
      Piece<T> value[kParts][2];
#pragma unroll
      for (int r = 0; r < 2; ++r) {
        Piece<T> pieces[kParts];
#pragma unroll
        for (int row = 0; row < kParts; ++row) {
          pieces[row] = Piece<T>::load(space[r][row] + c);
          if constexpr (kLines) {
#pragma unroll
            for (int axis = 0; axis < 3; ++axis) {
              const T* node = static_cast<const T*>(in.lines.values) + in.lines.starts[level][axis] + (left[r][row][axis] + c);
              pieces[row].modulate(Piece<T>::load(node), Piece<T>::load(node + right[axis]), fraction[r][row][axis]);
            }
          }
        }
        if constexpr (kParts == 2) {
          exchange_halves(pieces[0], pieces[1], odd != 0);
          value[1][r] = pieces[1];
        }
        value[0][r] = pieces[0];
      }
#pragma unroll
      for (int part = 0; part < kParts; ++part) first_layer(sums, value[part], w + part * kQuad, stride);
    }
  }

  const int hidden_stride = net.hidden_stride(kItem);
  for (int layer = 1; layer < net.layers; ++layer) {
#pragma unroll
    for (int t = 0; t < kBlocks; ++t)
      for (int r = 0; r < 2; ++r) {
        const float2 pair = make_float2(rectified(sums[t][2 * r]), rectified(sums[t][2 * r + 1]));
        sums[t][2 * r] = pair.x, sums[t][2 * r + 1] = pair.y;
        if (hidden != nullptr && rows[r] < count)
          *reinterpret_cast<float2*>(hidden + ((layer - 1) * in.count + rows[r]) * kWidth + 8 * t + 2 * place.quad) = pair;
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
      float* to = deltas + (in.order != nullptr ? in.order[rows[r]] : rows[r]) * int64_t(kRawColumns) + 2 * place.quad;
      *reinterpret_cast<float2*>(to) = make_float2(out[0][2 * r], out[0][2 * r + 1]);
      *reinterpret_cast<float2*>(to + 8) = make_float2(out[1][2 * r], out[1][2 * r + 1]);
    }
  }
}

template <class T, int kWidth>
void launch(const FieldInput& in, const FieldNetwork& net, const void* packed, float* deltas, float* hidden,
            cudaStream_t stream) {
  bool wide = true;
  for (int level = 0; level < in.levels; ++level)
    for (const int32_t width : in.lines.widths[level]) wide = wide && width > 1;
  auto kernel = wide && in.channels == 64   ? deltas_kernel<T, kWidth, true, 64>
                : wide && in.channels == 32 ? deltas_kernel<T, kWidth, true, 32>
                                            : deltas_kernel<T, kWidth, true, 0>;
  if constexpr (std::is_same_v<T, float>) {  // only training stores the trunk's outputs, in float32
    if (in.lines.values == nullptr) kernel = deltas_kernel<T, kWidth, false, 0>;
  }
  constexpr int kWarps = warps_of(int(sizeof(T)), kWidth);
  const int bytes = int(net.packed_bytes(int(sizeof(T))));
  check_cuda(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, bytes), "reserving shared memory");
  kernel<<<blocks_for(in.count, kRowsPerWarp * kWarps), 32 * kWarps, bytes, stream>>>(in, net, packed, deltas, hidden);
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

}  // namespace gsplat::hexplane
