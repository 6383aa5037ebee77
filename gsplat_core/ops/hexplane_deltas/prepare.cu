// Interpolates the time planes into lines at one time, and packs the network for shared memory.
#include <cuda_fp16.h>

#include "../hexplane/line_position.h"
#include "cuda_scratch.h"
#include "network.h"

namespace gsplat::hexplane {
namespace {

using namespace GSPLAT_ISA::hexplane;

__device__ void put(float* to, int64_t at, float x) { to[at] = x; }
__device__ void put(__half* to, int64_t at, float x) { to[at] = __float2half_rn(x); }

// Return the weight at index `at` of the packed network. After the first layer, inputs are in the order of the previous
// layer's register layout: with half, pairs of two column blocks of 8 are interleaved; with float, the order is
// unchanged.
template <class T>
__device__ float packed_weight(const FieldNetwork& net, int at) {
  constexpr int kItem = int(sizeof(T));
  int layer = 0, stride = net.first_stride(kItem);
  if (at >= net.hidden_start(1, kItem)) {
    stride = net.hidden_stride(kItem);
    at -= net.hidden_start(1, kItem);
    layer = 1 + at / (net.padded_width() * stride);
    if (layer > net.layers - 1) layer = net.layers - 1;
    at -= (layer - 1) * net.padded_width() * stride;
  }
  const int row = at / stride, place = at % stride, inputs = layer == 0 ? net.features : net.width;
  const int input = layer == 0 || kItem == 4 ? place : place / 16 * 16 + place % 4 / 2 * 8 + place % 16 / 4 * 2 + place % 2;
  const bool head = layer == net.layers - 1;
  const int output = head ? head_output(row) : row;
  return output >= 0 && (head || output < net.width) && input < inputs ? net.weights[layer][output * inputs + input] : 0.0f;
}

__device__ float packed_bias(const FieldNetwork& net, int at) {
  const int layer = min(at / net.padded_width(), net.layers - 1), row = at - layer * net.padded_width();
  const bool head = layer == net.layers - 1;
  const int output = head ? head_output(row) : row;
  return output >= 0 && (head || output < net.width) ? net.biases[layer][output] : 0.0f;
}

// Interpolate the lines and pack the network. blockIdx.y selects a line; the last index selects the network.
template <class T>
__global__ void __launch_bounds__(kThreads)
    prepare(FieldTimePlanes planes, FieldInput input, const float* time, FieldNetwork net, void* packed) {
  const int64_t first = int64_t(blockIdx.x) * kThreads + threadIdx.x, step = int64_t(gridDim.x) * kThreads;
  const int line = int(blockIdx.y), lines = input.lines.values != nullptr ? 3 * input.levels : 0;
  if (line < lines) {
    const int level = line / 3, axis = line % 3;
    const int64_t size = int64_t(input.lines.widths[level][axis]) * input.channels;
    const int32_t rows = planes.rows[level][axis];
    const LinePosition at = position_on(*time, rows);
    const float* near = planes.values[level][axis] + at.cell * size;
    const float* far = near + (rows > 1 ? size : 0);
    T* to = static_cast<T*>(input.lines.values) + input.lines.starts[level][axis];
    for (int64_t i = first; i < size; i += step) {
      const float a = near[i], b = far[i];
      put(to, i, a + at.fraction * (b - a));
    }
    return;
  }
  if (packed == nullptr) return;
  const int items = net.weight_items(int(sizeof(T))), biases = net.bias_floats();
  T* weights = static_cast<T*>(packed);
  float* bias = reinterpret_cast<float*>(weights + items);
  for (int64_t i = first; i < items; i += step) put(weights, i, packed_weight<T>(net, int(i)));
  for (int64_t i = first; i < biases; i += step) bias[i] = packed_bias(net, int(i));
}

}  // namespace

void prepare_field(const FieldTimePlanes& planes, const FieldInput& input, const float* time, const FieldNetwork* network,
                   void* packed, bool half, cudaStream_t stream) {
  const unsigned lines = input.lines.values != nullptr ? unsigned(3 * input.levels) : 0;
  const FieldNetwork net = network != nullptr ? *network : FieldNetwork{};
  const dim3 grid(32, lines + (packed != nullptr ? 1 : 0));
  if (grid.y == 0) return;
  (half ? prepare<__half> : prepare<float>)<<<grid, kThreads, 0, stream>>>(planes, input, time, net, packed);
}

}  // namespace gsplat::hexplane
