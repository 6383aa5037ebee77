// Channels are contiguous in memory, so each corner of a bilinear sample is read as consecutive vectors.
#include "hexplane.h"
#include "line_position.h"
#include "simd_partial.h"

namespace GSPLAT_ISA::hexplane {

using namespace gsplat::hexplane;

namespace {

// The four cells around a point in one plane, and their weights. Corners are aligned, and coordinates are clamped at
// the border.
struct Corners {
  const float *p00, *p10, *p01, *p11;  // first subscript along U, second along V
  float fu, fv;                        // fractional positions
  float du, dv;                        // cells per unit of the coordinate, zero at the border and beyond
};

GSPLAT_INLINE Corners corners_of(const FeaturePlane& plane, float u, float v, int64_t channels) {
  const LinePosition a = position_on(u, plane.width), b = position_on(v, plane.height);
  const int64_t right = plane.width > 1 ? channels : 0, below = plane.height > 1 ? plane.width * channels : 0;
  const float* p = plane.values + (b.cell * plane.width + a.cell) * channels;
  return {p, p + right, p + below, p + right + below, a.fraction, b.fraction, a.slope, b.slope};
}

GSPLAT_INLINE vfloat sample(const Corners& c, int64_t channel, int64_t lanes) {
  const vfloat p00 = load_first(c.p00 + channel, lanes), p10 = load_first(c.p10 + channel, lanes);
  const vfloat p01 = load_first(c.p01 + channel, lanes), p11 = load_first(c.p11 + channel, lanes);
  const vfloat top = p00 + c.fu * (p10 - p00), bottom = p01 + c.fu * (p11 - p01);
  return top + c.fv * (bottom - top);
}

GSPLAT_INLINE int64_t lanes_at(int64_t channel, int64_t channels) {
  return channels - channel < kLanes ? channels - channel : kLanes;
}

void product(const HexPlanes& level, int first, int last, float* features, int64_t begin, int64_t end) {
  const int64_t channels = level.channels;
  for (int64_t n = begin; n < end; ++n) {
    const float* x = level.coordinates + n * 4;
    Corners corners[kPlanes];
    for (int p = first; p < last; ++p)
      corners[p] = corners_of(level.planes[p], x[kPlaneAxes[p][0]], x[kPlaneAxes[p][1]], channels);
    for (int64_t c = 0; c < channels; c += kLanes) {
      const int64_t lanes = lanes_at(c, channels);
      vfloat value = sample(corners[first], c, lanes);
      for (int p = first + 1; p < last; ++p) value *= sample(corners[p], c, lanes);
      store_first(features + n * channels + c, value, lanes);
    }
  }
}

void backward_samples(const HexPlanes& level, const float* gradient, float* sample_gradients, float* coordinate_gradients,
                      int64_t block, int64_t begin, int64_t end) {
  const int64_t channels = level.channels;
  for (int64_t n = begin; n < end; ++n) {
    const float* x = level.coordinates + n * 4;
    Corners corners[kPlanes];
    vfloat along_u[kPlanes] = {}, along_v[kPlanes] = {};
    for (int p = 0; p < kPlanes; ++p)
      corners[p] = corners_of(level.planes[p], x[kPlaneAxes[p][0]], x[kPlaneAxes[p][1]], channels);
    for (int64_t c = 0; c < channels; c += kLanes) {
      const int64_t lanes = lanes_at(c, channels);
      vfloat values[kPlanes], before[kPlanes];  // before: product of the preceding planes
      vfloat value = load_first(gradient + n * channels + c, lanes);
      for (int p = 0; p < kPlanes; ++p) {
        values[p] = sample(corners[p], c, lanes);
        before[p] = value;
        value *= values[p];
      }
      vfloat after = splat(1.0f);
      for (int p = kPlanes - 1; p >= 0; --p) {
        const vfloat g = before[p] * after;
        after *= values[p];
        store_first(sample_gradients + (p * kBackwardBlock + n - block) * channels + c, g, lanes);
        const Corners& k = corners[p];
        const vfloat p00 = load_first(k.p00 + c, lanes), p10 = load_first(k.p10 + c, lanes);
        const vfloat p01 = load_first(k.p01 + c, lanes), p11 = load_first(k.p11 + c, lanes);
        along_u[p] += g * ((p10 - p00) + k.fv * ((p11 - p01) - (p10 - p00)));
        along_v[p] += g * ((p01 - p00) + k.fu * ((p11 - p10) - (p01 - p00)));
      }
    }
    float* gx = coordinate_gradients + n * 4;
    gx[0] = gx[1] = gx[2] = gx[3] = 0;
    for (int p = 0; p < kPlanes; ++p) {
      gx[kPlaneAxes[p][0]] += sum(along_u[p]) * corners[p].du;
      gx[kPlaneAxes[p][1]] += sum(along_v[p]) * corners[p].dv;
    }
  }
}

void scatter(const HexPlanes& level, int plane, const float* sample_gradients, float* plane_gradient, int64_t first, int64_t last,
             int64_t block, int64_t end) {
  const FeaturePlane shape = {plane_gradient, level.planes[plane].width, level.planes[plane].height};
  const int64_t channels = level.channels;
  for (int64_t n = block; n < end; ++n) {
    const float* x = level.coordinates + n * 4;
    const Corners k = corners_of(shape, x[kPlaneAxes[plane][0]], x[kPlaneAxes[plane][1]], channels);
    float* corners[4] = {plane_gradient + (k.p00 - plane_gradient), plane_gradient + (k.p10 - plane_gradient),
                         plane_gradient + (k.p01 - plane_gradient), plane_gradient + (k.p11 - plane_gradient)};
    const float weights[4] = {(1 - k.fu) * (1 - k.fv), k.fu * (1 - k.fv), (1 - k.fu) * k.fv, k.fu * k.fv};
    for (int64_t c = first; c < last; c += kLanes) {
      const int64_t lanes = lanes_at(c, last);
      const vfloat g = load_first(sample_gradients + (plane * kBackwardBlock + n - block) * channels + c, lanes);
      for (int i = 0; i < 4; ++i) store_first(corners[i] + c, load_first(corners[i] + c, lanes) + weights[i] * g, lanes);
    }
  }
}

void modulate(const HexPlanes& level, const float* space, float* features, int64_t begin, int64_t end) {
  const int64_t channels = level.channels;
  for (int64_t n = begin; n < end; ++n) {
    const float* left[3];
    int64_t right[3];
    float fraction[3];
    for (int axis = 0; axis < 3; ++axis) {
      const FeaturePlane& line = level.planes[axis];
      const LinePosition at = position_on(level.coordinates[n * 4 + axis], line.width);
      left[axis] = line.values + at.cell * channels;
      right[axis] = line.width > 1 ? channels : 0;
      fraction[axis] = at.fraction;
    }
    for (int64_t c = 0; c < channels; c += kLanes) {
      const int64_t lanes = lanes_at(c, channels);
      vfloat value = load_first(space + n * channels + c, lanes);
      for (int axis = 0; axis < 3; ++axis) {
        const vfloat a = load_first(left[axis] + c, lanes), b = load_first(left[axis] + right[axis] + c, lanes);
        value *= a + fraction[axis] * (b - a);
      }
      store_first(features + n * channels + c, value, lanes);
    }
  }
}

// Size of the block of outputs that a micro-kernel keeps in registers: rows x vectors of accumulators, next to the
// weight vectors and one broadcast input.
#if defined(__AVX512F__)
constexpr int kTileRows = 6, kTileVectors = 4;
#else
constexpr int kTileRows = 4, kTileVectors = 2;
#endif
static_assert(kBlockRows % kTileRows == 0, "a block is whole tiles");

// Compute outputs[r, first + v] = bias + inputs[r, :] . weights[:, first + v] for one tile.
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
      // `s < 0` instead of `s > 0`, so that NaN propagates.
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

// Compute the features of Gaussian n: space times lines, levels concatenated.
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

extern const Kernels kernels = {product, backward_samples, scatter, modulate, kLanes, decode};

}  // namespace GSPLAT_ISA::hexplane
