// A vector of points at a time for each splat; sums over points in blocks, added up in double.
#include "splat_regression.h"

#include "simd.h"
#include "splat_regression_math.h"

namespace GSPLAT_ISA::splat_regression {

using namespace gsplat::splat_regression;

namespace {

constexpr float kLog2E = 1.44269504f;
constexpr int64_t kBlock = 2048;  // points summed in float32 before the double sums
constexpr int kChunk = 4;         // channels accumulated in registers

void records(const Inputs& in, int64_t begin, int64_t end, Splat* out) {
  for (int64_t i = begin; i < end; ++i) out[i] = prepared(in, i, [](double x) { return __builtin_log2(x); });
}

// Return g at a vector of points, and y = A^-1 (x - b) in `y`.
template <int D>
GSPLAT_INLINE vfloat density(const Splat& s, const float* points, int64_t stride, vfloat* y) {
  vfloat offset[D], squared = {};
  for (int k = 0; k < D; ++k) offset[k] = load(points + k * stride) - s.centre[k];
  for (int r = 0; r < D; ++r) {
    y[r] = s.whiten[r * D] * offset[0];
    for (int k = 1; k < D; ++k) y[r] = fma(splat(s.whiten[r * D + k]), offset[k], y[r]);
    squared = fma(y[r], y[r], squared);
  }
  const vfloat power = fma(splat(-0.5f * kLog2E), squared, splat(s.log2_norm));
  // NaN from a non-finite point compares false, so that the result is 0.
  const vmask counts = at_least(power, splat(-126.0f));
  for (int r = 0; r < D; ++r) y[r] = zero_unless(counts, y[r]);
  return zero_unless(counts, exp2(min(max(power, splat(-126.0f)), splat(126.0f))));
}

template <int D>
void forward_of(const Inputs& in, const Rows& rows, int64_t begin, int64_t end, float* out) {
  for (int first = 0; first < in.channels; first += kChunk) {
    const int channels = in.channels - first < kChunk ? in.channels - first : kChunk;
    for (int64_t at = begin; at < end; at += kLanes) {
      vfloat sums[kChunk] = {};
      for (int64_t i = 0; i < in.splats; ++i) {
        const Splat& s = rows.records[i];
        if (!(s.log2_norm > -__builtin_huge_valf())) continue;
        vfloat y[D];
        const vfloat g = density<D>(s, rows.points + at, rows.stride, y);
        const float* const value = in.values + i * in.channels + first;
        for (int c = 0; c < channels; ++c) sums[c] = fma(splat(value[c]), g, sums[c]);
      }
      for (int c = 0; c < channels; ++c) store(out + (first + c) * rows.stride + at, sums[c]);
    }
  }
}

template <int D>
void backward_of(const Inputs& in, const Rows& rows, const float* gradient, int64_t begin, int64_t end, const Gradients& out,
                 float* lanes, double* sums) {
  constexpr int kMoments = moments_of(D);
  const int columns = kMoments + in.channels;
  for (int64_t i = begin; i < end; ++i) {
    const Splat& s = rows.records[i];
    const float* const value = in.values + i * in.channels;
    for (int k = 0; k < columns; ++k) sums[k] = 0;
    const bool usable = s.log2_norm > -__builtin_huge_valf();
    for (int64_t block = 0; usable && block < rows.stride; block += kBlock) {
      const int64_t stop = block + kBlock < rows.stride ? block + kBlock : rows.stride;
      vfloat moments[kMoments] = {};
      for (int c = 0; c < in.channels; ++c) store(lanes + c * kLanes, vfloat{});
      for (int64_t at = block; at < stop; at += kLanes) {
        vfloat y[D], along = {};
        const vfloat g = density<D>(s, rows.points + at, rows.stride, y);
        for (int c = 0; c < in.channels; ++c) {
          const vfloat v = load(gradient + c * rows.stride + at);
          along = fma(splat(value[c]), v, along);
          store(lanes + c * kLanes, fma(g, v, load(lanes + c * kLanes)));
        }
        const vfloat h = g * along;
        moments[0] += h;
        int next = 1 + D;
        for (int r = 0; r < D; ++r) {
          const vfloat weighted = h * y[r];
          moments[1 + r] += weighted;
          for (int k = r; k < D; ++k, ++next) moments[next] = fma(weighted, y[k], moments[next]);
        }
      }
      for (int k = 0; k < kMoments; ++k) sums[k] += double(sum(moments[k]));
      for (int c = 0; c < in.channels; ++c) sums[kMoments + c] += double(sum(load(lanes + c * kLanes)));
    }
    gradients_of(in, i, s, sums, out);
    for (int c = 0; c < in.channels; ++c) out.values[i * in.channels + c] = float(sums[kMoments + c]);
  }
}

void forward(const Inputs& in, const Rows& rows, int64_t begin, int64_t end, float* out) {
  switch (in.dims) {
    case 1: return forward_of<1>(in, rows, begin, end, out);
    case 2: return forward_of<2>(in, rows, begin, end, out);
    case 3: return forward_of<3>(in, rows, begin, end, out);
    default: return forward_of<4>(in, rows, begin, end, out);
  }
}

void backward(const Inputs& in, const Rows& rows, const float* gradient, int64_t begin, int64_t end, const Gradients& out,
              float* lanes, double* sums) {
  switch (in.dims) {
    case 1: return backward_of<1>(in, rows, gradient, begin, end, out, lanes, sums);
    case 2: return backward_of<2>(in, rows, gradient, begin, end, out, lanes, sums);
    case 3: return backward_of<3>(in, rows, gradient, begin, end, out, lanes, sums);
    default: return backward_of<4>(in, rows, gradient, begin, end, out, lanes, sums);
  }
}

}  // namespace

extern const Kernels kernels = {records, forward, backward};

}  // namespace GSPLAT_ISA::splat_regression
