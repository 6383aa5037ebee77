// Channels are side by side in memory, so each corner of a bilinear sample is one run of vectors.
#include "hexplane.h"
#include "line_position.h"
#include "simd_partial.h"

namespace GSPLAT_ISA {
namespace {

// The four cells around a point of one plane (corners aligned, clamped at the border) and their weights.
struct Corners {
  const float *p00, *p10, *p01, *p11;  // first index along U, second along V
  float fu, fv;                        // fractions
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
      vfloat values[kPlanes], before[kPlanes];  // before: product of the planes before this one
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

}  // namespace

extern const HexPlaneKernels hexplane_kernels = {product, backward_samples, scatter, modulate};

}  // namespace GSPLAT_ISA
