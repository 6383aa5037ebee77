#include "hexplane_decode.h"
#include "line_position.h"
#include "simd_partial.h"

namespace GSPLAT_ISA {
namespace {

// Tile of outputs that a micro-kernel keeps in registers: rows x vectors accumulators, the vectors' weights, one broadcast.
#if defined(__AVX512F__)
constexpr int kTileRows = 6, kTileVectors = 4;
#else
constexpr int kTileRows = 4, kTileVectors = 2;
#endif
static_assert(kBlockRows % kTileRows == 0, "a block is whole tiles");

// outputs[r, first + v] = bias + inputs[r, :] . weights[:, first + v], for one tile.
template <int kVectors>
GSPLAT_INLINE void tile(const DecodeLayer& layer, const float* inputs, float* outputs, int64_t stride, int64_t first, bool relu) {
  vfloat sums[kTileRows][kVectors];
  for (int v = 0; v < kVectors; ++v) {
    const vfloat bias = load(layer.bias + first + v * kLanes);
    for (int r = 0; r < kTileRows; ++r) sums[r][v] = bias;
  }
  const float* weights = layer.weights + first;
  for (int64_t k = 0; k < layer.inputs; ++k, weights += layer.padded_outputs) {
    vfloat w[kVectors];
    for (int v = 0; v < kVectors; ++v) w[v] = load(weights + v * kLanes);
#pragma GCC unroll 8
    for (int r = 0; r < kTileRows; ++r) {
      const float x = inputs[r * stride + k];
#pragma GCC unroll 4
      for (int v = 0; v < kVectors; ++v) sums[r][v] += x * w[v];
    }
  }
  for (int r = 0; r < kTileRows; ++r)
    for (int v = 0; v < kVectors; ++v) {
      // `s < 0` and not `s > 0`, so that NaN stays and shows.
      const vfloat s = sums[r][v];
      store(outputs + r * stride + first + v * kLanes, relu ? select(s < 0.0f, vfloat{}, s) : s);
    }
}

void apply_layer(const DecodeLayer& layer, const float* inputs, float* outputs, int64_t stride, int64_t rows, bool relu) {
  for (int64_t r = 0; r < rows; r += kTileRows) {
    int64_t first = 0;
    for (; first + kTileVectors * kLanes <= layer.padded_outputs; first += kTileVectors * kLanes)
      tile<kTileVectors>(layer, inputs + r * stride, outputs + r * stride, stride, first, relu);
    for (; first < layer.padded_outputs; first += kLanes)
      tile<1>(layer, inputs + r * stride, outputs + r * stride, stride, first, relu);
  }
}

// The features of Gaussian n: space times lines, levels side by side.
void features_of(const Decode& d, int64_t n, float* features) {
  for (int l = 0; l < d.level_count; ++l) {
    const DecodeLevel& level = d.levels[l];
    const int64_t channels = level.channels;
    const float* space = level.space + n * channels;
    LinePosition at[3] = {};
    for (int axis = 0; axis < 3 && level.lines[0]; ++axis)
      at[axis] = position_on(d.coordinates[n * 4 + axis], level.widths[axis]);
    for (int64_t c = 0; c < channels; c += kLanes) {
      const int64_t lanes = channels - c < kLanes ? channels - c : kLanes;
      vfloat value = load_first(space + c, lanes);
      for (int axis = 0; axis < 3 && level.lines[0]; ++axis) {
        const float* left = level.lines[axis] + at[axis].cell * channels + c;
        const vfloat a = load_first(left, lanes), b = load_first(left + (level.widths[axis] > 1 ? channels : 0), lanes);
        value *= a + at[axis].fraction * (b - a);
      }
      store_first(features + c, value, lanes);
    }
    features += channels;
  }
}

void decode(const Decode& d, float* buffer, int64_t begin, int64_t end) {
  for (int64_t from = begin; from < end; from += kBlockRows) {
    const int64_t count = end - from < kBlockRows ? end - from : kBlockRows;
    const int64_t rows = (count + kTileRows - 1) / kTileRows * kTileRows;
    float *now = buffer, *next = buffer + kBlockRows * d.stride;
    for (int64_t r = 0; r < count; ++r) features_of(d, from + r, now + r * d.stride);
    for (int i = 0; i < d.layer_count; ++i) {
      apply_layer(d.layers[i], now, next, d.stride, rows, i + 1 < d.layer_count);
      float* swap = now;
      now = next;
      next = swap;
    }
    for (int64_t r = 0; r < count; ++r)
      __builtin_memcpy(d.outputs + (from + r) * d.output_count, now + r * d.stride, size_t(d.output_count) * sizeof(float));
  }
}

}  // namespace

extern const DecodeKernels decode_kernels = {kLanes, decode};

}  // namespace GSPLAT_ISA
