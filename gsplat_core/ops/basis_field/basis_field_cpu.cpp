// Processes one Gaussian at a time: a vector of bumps to find the active ones, then one row of 13 channels per active
// bump.
#include "basis_field.h"
#include "simd_partial.h"

namespace GSPLAT_ISA::basis_field {

using namespace gsplat::basis_field;

namespace {

constexpr int kRowVectors = 16 / kLanes;
constexpr float kLog2e = 1.44269504f;

// 13 channels in the vectors of 16 floats; the last three lanes are zero.
struct Row {
  vfloat v[kRowVectors];
};

GSPLAT_INLINE int64_t row_lanes(int i) {
  const int64_t left = kBasisChannels - int64_t(i) * kLanes;
  return left < kLanes ? left : kLanes;
}

GSPLAT_INLINE Row load_row(const float* p) {
  Row r;
  for (int i = 0; i < kRowVectors; ++i) r.v[i] = load_first(p + i * kLanes, row_lanes(i));
  return r;
}

GSPLAT_INLINE void store_row(float* p, const Row& r) {
  for (int i = 0; i < kRowVectors; ++i) store_first(p + i * kLanes, r.v[i], row_lanes(i));
}

GSPLAT_INLINE float dot(const Row& a, const Row& b) {
  vfloat s = a.v[0] * b.v[0];
  for (int i = 1; i < kRowVectors; ++i) s += a.v[i] * b.v[i];
  return sum(s);
}

GSPLAT_INLINE bool is_zero(const Row& r) {
  uint32_t set = bits(r.v[0] != 0.0f);
  for (int i = 1; i < kRowVectors; ++i) set |= bits(r.v[i] != 0.0f);
  return set == 0;
}

GSPLAT_INLINE bool is_finite(const Row& r) {
  vfloat nan_if_not = r.v[0] * 0.0f;
  for (int i = 1; i < kRowVectors; ++i) nan_if_not += r.v[i] * 0.0f;
  return sum(nan_if_not) == 0.0f;
}

// Return true if every square is finite: an infinite second moment would freeze its parameter.
GSPLAT_INLINE bool is_usable(const Row& r) {
  vfloat nan_if_unusable = r.v[0] * r.v[0] * 0.0f;
  for (int i = 1; i < kRowVectors; ++i) nan_if_unusable += r.v[i] * r.v[i] * 0.0f;
  return sum(nan_if_unusable) == 0.0f;
}

// Consecutive bumps of one Gaussian at one time, one per lane.
struct Bumps {
  vfloat u, inverse_width, height;  // height is exp(-u^2), zero where inactive
  vint active;
  uint32_t mask;  // `active`, one bit per bump
};

// A bump with a NaN centre or width counts as active, so that the NaN propagates.
GSPLAT_INLINE Bumps bumps_at(const float* centers, const float* log_widths, int64_t count, float tau) {
  Bumps b;
  const vfloat log_width = load_first(log_widths, count);
  const vfloat exponent = min(max(log_width * -kLog2e, splat(-126.0f)), splat(126.0f));
  b.inverse_width = select(log_width == log_width, exp2(exponent), log_width);
  b.u = (tau - load_first(centers, count)) * b.inverse_width;
  b.active = ~((b.u > kBasisReach) | (b.u < -kBasisReach)) & first_lanes(count);
  const vfloat height = exp2(max(b.u * b.u * -kLog2e, splat(-126.0f)));
  b.height = select(b.active, select(b.u == b.u, height, b.u), vfloat{});
  b.mask = bits(b.active);
  return b;
}

constexpr int64_t kAhead = 8;  // Gaussians

// Prefetch the rows of the Gaussian `kAhead` positions later. Neighbouring Gaussians have nearly the same active bumps,
// but the stride between their rows is too large for the hardware prefetcher. A prefetch past the end of the tensor has
// no effect.
template <bool kWrite>
GSPLAT_INLINE void prefetch_rows(const float* weights, int64_t row, int64_t bumps, uint32_t mask) {
  const int64_t first = row + kAhead * bumps + __builtin_ctz(mask), last = row + kAhead * bumps + 31 - __builtin_clz(mask);
  const char* end = (const char*)(weights + (last + 1) * kBasisChannels);
  for (const char* line = (const char*)(weights + first * kBasisChannels); line < end; line += 64)
    __builtin_prefetch(line, kWrite, 3);
}

GSPLAT_INLINE int64_t lanes_left(int64_t from, int64_t bumps) { return bumps - from < kLanes ? bumps - from : kLanes; }

void forward(const BasisBumps& field, float* deltas, int64_t begin, int64_t end) {
  for (int64_t n = begin; n < end; ++n) {
    Row total = {};
    const int64_t first = n * field.bumps;
    for (int64_t from = 0; from < field.bumps; from += kLanes) {
      const Bumps b =
          bumps_at(field.centers + first + from, field.log_widths + first + from, lanes_left(from, field.bumps), field.tau);
      float heights[kLanes];
      store(heights, b.height);
      if (b.mask != 0) prefetch_rows<false>(field.weights, first + from, field.bumps, b.mask);
      for (uint32_t left = b.mask; left != 0; left &= left - 1) {
        const int lane = __builtin_ctz(left);
        const Row w = load_row(field.weights + (first + from + lane) * kBasisChannels);
        for (int i = 0; i < kRowVectors; ++i) total.v[i] += heights[lane] * w.v[i];
      }
    }
    float* to = deltas + n * field.row;
    store_row(to, total);
    for (int64_t c = kBasisChannels; c < field.row; ++c) to[c] = 0;
  }
}

void backward(const BasisBumps& field, const float* gradient, float* centers, float* log_widths, float* weights, int64_t begin,
              int64_t end) {
  for (int64_t n = begin; n < end; ++n) {
    const Row g = load_row(gradient + n * field.row);
    const int64_t first = n * field.bumps;
    __builtin_memset(weights + first * kBasisChannels, 0, size_t(field.bumps * kBasisChannels) * sizeof(float));
    for (int64_t from = 0; from < field.bumps; from += kLanes) {
      const int64_t at = first + from, count = lanes_left(from, field.bumps);
      const Bumps b = bumps_at(field.centers + at, field.log_widths + at, count, field.tau);
      float heights[kLanes], along[kLanes] = {};  // along = g . w
      store(heights, b.height);
      for (uint32_t left = b.mask; left != 0; left &= left - 1) {
        const int lane = __builtin_ctz(left);
        along[lane] = dot(g, load_row(field.weights + (at + lane) * kBasisChannels));
        Row w;
        for (int i = 0; i < kRowVectors; ++i) w.v[i] = heights[lane] * g.v[i];
        store_row(weights + (at + lane) * kBasisChannels, w);
      }
      const vfloat slope = b.height * 2.0f * b.u * load(along);
      store_first(centers + at, select(b.active, slope * b.inverse_width, vfloat{}), count);
      store_first(log_widths + at, select(b.active, slope * b.u, vfloat{}), count);
    }
  }
}

// Two passes over a Gaussian's bumps. The first sums their deltas, and the second changes their weights by the difference
// from the target. Its data are still in the cache.
void move_to(const BasisBumps& field, float* weights, const float* target, int64_t begin, int64_t end) {
  for (int64_t n = begin; n < end; ++n) {
    const int64_t first = n * field.bumps;
    Row change = load_row(target + n * field.row);
    float squares = 0;
    for (int64_t from = 0; from < field.bumps; from += kLanes) {
      const int64_t at = first + from;
      const Bumps b = bumps_at(field.centers + at, field.log_widths + at, lanes_left(from, field.bumps), field.tau);
      if (b.mask == 0) continue;
      float heights[kLanes];
      store(heights, b.height);
      squares += sum(b.height * b.height);
      prefetch_rows<true>(weights, at, field.bumps, b.mask);
      for (uint32_t left = b.mask; left != 0; left &= left - 1) {
        const int lane = __builtin_ctz(left);
        const Row w = load_row(weights + (at + lane) * kBasisChannels);
        for (int i = 0; i < kRowVectors; ++i) change.v[i] -= heights[lane] * w.v[i];
      }
    }
    if (!(squares > kLeastSquaredHeights) || !is_finite(change)) continue;
    for (int64_t from = 0; from < field.bumps; from += kLanes) {
      const int64_t at = first + from;
      const Bumps b = bumps_at(field.centers + at, field.log_widths + at, lanes_left(from, field.bumps), field.tau);
      float shares[kLanes];
      store(shares, b.height / squares);
      for (uint32_t left = b.mask; left != 0; left &= left - 1) {
        const int lane = __builtin_ctz(left);
        float* const row = weights + (at + lane) * kBasisChannels;
        Row w = load_row(row);
        for (int i = 0; i < kRowVectors; ++i) w.v[i] += shares[lane] * change.v[i];
        store_row(row, w);
      }
    }
  }
}

// One Adam update of a vector: parameter, moments, gradient, rate / (1 - beta1^k), 1 / sqrt(1 - beta2^k).
GSPLAT_INLINE void adam_update(vfloat& p, vfloat& m, vfloat& v, vfloat g, vfloat rate, vfloat inverse_root_bias2,
                               const BasisAdam& a) {
  m += (1 - a.beta1) * (g - m);
  v += (1 - a.beta2) * (g * g - v);
  p -= rate * m / (square_root(v) * inverse_root_bias2 + a.epsilon);
}

// Apply `adam_update` to the active lanes of one [N, B] tensor.
GSPLAT_INLINE void adam_update_active(float* p, float* m, float* v, vfloat g, vint active, vfloat rate, vfloat inverse_root_bias2,
                                      int64_t count, const BasisAdam& a) {
  const vfloat p0 = load_first(p, count), m0 = load_first(m, count), v0 = load_first(v, count);
  vfloat p1 = p0, m1 = m0, v1 = v0;
  adam_update(p1, m1, v1, g, rate, inverse_root_bias2, a);
  store_first(p, select(active, p1, p0), count);
  store_first(m, select(active, m1, m0), count);
  store_first(v, select(active, v1, v0), count);
}

void adam(const BasisAdam& field, const float* gradient, int64_t begin, int64_t end) {
  Row rates;
  for (int i = 0; i < kRowVectors; ++i) rates.v[i] = load(field.channel_rates + i * kLanes);
  for (int64_t n = begin; n < end; ++n) {
    const Row g = load_row(gradient + n * field.row);
    if (is_zero(g) || !is_usable(g)) continue;  // not visible in this frame, or not finite
    const int64_t first = n * field.bumps;
    for (int64_t from = 0; from < field.bumps; from += kLanes) {
      const int64_t at = first + from, count = lanes_left(from, field.bumps);
      const Bumps b = bumps_at(field.centers + at, field.log_widths + at, count, field.tau);
      if (b.mask == 0) continue;
      prefetch_rows<true>(field.weights, at, field.bumps, b.mask);
      prefetch_rows<true>(field.m_weights, at, field.bumps, b.mask);
      prefetch_rows<true>(field.v_weights, at, field.bumps, b.mask);
      float heights[kLanes], along[kLanes] = {}, bias1[kLanes] = {}, bias2[kLanes] = {};
      store(heights, b.height);
      for (uint32_t left = b.mask; left != 0; left &= left - 1) {
        const int lane = __builtin_ctz(left);
        const int64_t updates = ++field.steps[at + lane];
        const int64_t entry = updates < field.table_size ? updates : field.table_size - 1;
        bias1[lane] = field.inverse_bias1[entry];
        bias2[lane] = field.inverse_root_bias2[entry];
        const int64_t row = (at + lane) * kBasisChannels;
        Row w = load_row(field.weights + row), m = load_row(field.m_weights + row), v = load_row(field.v_weights + row);
        along[lane] = dot(g, w);  // before the update
        for (int i = 0; i < kRowVectors; ++i)
          adam_update(w.v[i], m.v[i], v.v[i], heights[lane] * g.v[i], rates.v[i] * bias1[lane], splat(bias2[lane]), field);
        store_row(field.weights + row, w);
        store_row(field.m_weights + row, m);
        store_row(field.v_weights + row, v);
      }
      const vfloat slope = b.height * 2.0f * b.u * load(along), rate = load(bias1), root = load(bias2);
      adam_update_active(field.centers + at, field.m_centers + at, field.v_centers + at, slope * b.inverse_width, b.active,
                         field.center_rate * rate, root, count, field);
      adam_update_active(field.log_widths + at, field.m_log_widths + at, field.v_log_widths + at, slope * b.u, b.active,
                         field.width_rate * rate, root, count, field);
    }
  }
}

// Minimum-norm change of the colour weights: proportional to the heights, divided by the sum of their squares.
void add_colours(const BasisBumps& field, float* weights, const float* change, int64_t begin, int64_t end) {
  for (int64_t n = begin; n < end; ++n) {
    const float* const c = change + 3 * n;
    const float size = c[0] * c[0] + c[1] * c[1] + c[2] * c[2];
    if (!(size > 0 && size * 0.0f == 0.0f)) continue;  // zero or not finite
    const int64_t first = n * field.bumps;
    float squared = 0;
    for (int64_t from = 0; from < field.bumps; from += kLanes) {
      const Bumps b =
          bumps_at(field.centers + first + from, field.log_widths + first + from, lanes_left(from, field.bumps), field.tau);
      if (b.mask != 0) squared += sum(b.height * b.height);
    }
    if (!(squared > kLeastSquaredHeights)) continue;
    for (int64_t from = 0; from < field.bumps; from += kLanes) {
      const Bumps b =
          bumps_at(field.centers + first + from, field.log_widths + first + from, lanes_left(from, field.bumps), field.tau);
      float heights[kLanes];
      store(heights, b.height);
      if (b.mask != 0) prefetch_rows<true>(field.weights, first + from, field.bumps, b.mask);
      for (uint32_t left = b.mask; left != 0; left &= left - 1) {
        const int lane = __builtin_ctz(left);
        float* const to = weights + (first + from + lane) * kBasisChannels + kRawColor;
        for (int j = 0; j < 3; ++j) to[j] += heights[lane] / squared * c[j];
      }
    }
  }
}

}  // namespace

extern const Kernels kernels = {forward, backward, adam, move_to, add_colours};

}  // namespace GSPLAT_ISA::basis_field
