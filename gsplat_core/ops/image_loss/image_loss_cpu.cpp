#include "image_loss.h"
#include "simd.h"

namespace GSPLAT_ISA::image_loss {

using namespace gsplat::image_loss;

constexpr int kBlock = 768;  // floats per step; their tissue weights stay in the L1 cache

// Expand the mask to the floats of a block of whole pixels, as 0 or 1.
static void expand_mask(float* to, const uint8_t* mask, int64_t pixels, int channels) {
  if (channels == 3) {
    for (int64_t p = 0; p < pixels; ++p) {
      const float m = mask[p] ? 1.0f : 0.0f;
      to[3 * p] = m;
      to[3 * p + 1] = m;
      to[3 * p + 2] = m;
    }
    return;
  }
  for (int64_t p = 0; p < pixels; ++p)
    for (int c = 0; c < channels; ++c) to[p * channels + c] = mask[p] ? 1.0f : 0.0f;
}

GSPLAT_INLINE vfloat load_target(const float* p) { return load(p); }
GSPLAT_INLINE vfloat load_target(const uint8_t* p) {
  typedef uint8_t vbytes __attribute__((vector_size(kLanes)));
  vbytes bytes;
  __builtin_memcpy(&bytes, p, sizeof(bytes));
  return __builtin_convertvector(bytes, vfloat) / 255.0f;
}

// |x - y| over tissue, or its square, and the derivative. NaN outside of tissue is ignored; NaN in tissue propagates.
template <bool kSquared>
GSPLAT_INLINE vfloat difference_of(vfloat x, vfloat y, vfloat tissue, float scale, float* gradient) {
  const vfloat d = select(tissue > 0, x - y, vfloat{});
  if (kSquared) {
    store(gradient, scale * d);
    return d * d;
  }
  vfloat g = select(d > 0, splat(scale), select(d < 0, splat(-scale), vfloat{}));
  store(gradient, select(d == d, g, d));
  return select(d < 0, -d, d);
}

template <bool kSquared, typename Target>
static double colour_block(const float* x, const Target* y, const float* tissue, float* gradient, float scale, int n) {
  vfloat sums{};
  int i = 0;
  for (; i + kLanes <= n; i += kLanes)
    sums += difference_of<kSquared>(load(x + i), load_target(y + i), load(tissue + i), scale, gradient + i);
  if (i < n) {  // the remaining floats, in padded copies
    float xs[kLanes] = {}, ms[kLanes] = {}, gs[kLanes];
    Target ys[kLanes] = {};
    for (int lane = 0; i + lane < n; ++lane) xs[lane] = x[i + lane], ys[lane] = y[i + lane], ms[lane] = tissue[i + lane];
    sums += difference_of<kSquared>(load(xs), load_target(ys), load(ms), scale, gs);
    for (int lane = 0; i + lane < n; ++lane) gradient[i + lane] = gs[lane];
  }
  double total = 0;
  for (int lane = 0; lane < kLanes; ++lane) total += sums[lane];
  return total;
}

template <bool kSquared, typename Target>
static void colour_rows_of(const ColourTask& task, const Target* target, int64_t row_begin, int64_t row_end) {
  const int c = task.channels;
  const int64_t block_px = kBlock / c;
  float tissue[kBlock];
  for (int i = 0; i < kBlock; ++i) tissue[i] = 1;
  for (int64_t row = row_begin; row < row_end; ++row) {
    double total = 0;
    for (int64_t px = 0; px < task.width; px += block_px) {
      const int64_t pixels = task.width - px < block_px ? task.width - px : block_px, first = row * task.width + px;
      if (task.mask) expand_mask(tissue, task.mask + first, pixels, c);
      total += colour_block<kSquared>(task.image + first * c, target + first * c, tissue, task.gradient + first * c, task.scale,
                                      int(pixels * c));
    }
    task.sums[row] = total;
  }
}

template <typename Target>
static void colour_rows_to(const ColourTask& task, const Target* target, int64_t row_begin, int64_t row_end) {
  if (task.squared)
    colour_rows_of<true>(task, target, row_begin, row_end);
  else
    colour_rows_of<false>(task, target, row_begin, row_end);
}

static void colour_rows(const ColourTask& task, int64_t row_begin, int64_t row_end) {
  if (task.target_bytes)
    colour_rows_to(task, task.target_bytes, row_begin, row_end);
  else
    colour_rows_to(task, task.target, row_begin, row_end);
}

// Mask of kLanes pixels at which both depths are known and the mask is tissue.
GSPLAT_INLINE vint valid_depth(const float* depth, const float* target, const uint8_t* mask) {
  vint valid = (load(depth) > 0) & (load(target) > 0);
  if (mask) {
    typedef uint8_t vbytes __attribute__((vector_size(kLanes)));
    vbytes bytes;
    __builtin_memcpy(&bytes, mask, sizeof(bytes));
    valid &= __builtin_convertvector(bytes, vint) != 0;
  }
  return valid;
}

// Call the function `on(offset, depth, target, mask, count)` for kLanes pixels at a time. The remaining pixels are
// passed as copies padded with invalid pixels.
template <typename Body>
GSPLAT_INLINE void for_row(const DepthTask& task, int64_t row, Body on) {
  const int64_t at = row * task.width;
  int64_t i = 0;
  for (; i + kLanes <= task.width; i += kLanes)
    on(at + i, task.depth + at + i, task.target + at + i, task.mask ? task.mask + at + i : nullptr, kLanes);
  if (i == task.width) return;
  float depth[kLanes] = {}, target[kLanes] = {};
  uint8_t mask[kLanes] = {};
  const int rest = int(task.width - i);
  for (int lane = 0; lane < rest; ++lane) {
    depth[lane] = task.depth[at + i + lane];
    target[lane] = task.target[at + i + lane];
    mask[lane] = task.mask ? task.mask[at + i + lane] : 1;
  }
  on(at + i, depth, target, mask, rest);
}

static void count_depth_rows(const DepthTask& task, int64_t row_begin, int64_t row_end) {
  for (int64_t row = row_begin; row < row_end; ++row) {
    vint counts{};
    for_row(task, row, [&](int64_t, const float* depth, const float* target, const uint8_t* mask, int) {
      counts -= valid_depth(depth, target, mask);  // a true lane is -1, so subtracting counts it
    });
    int64_t total = 0;
    for (int lane = 0; lane < kLanes; ++lane) total += counts[lane];
    task.counts[row] = total;
  }
}

static void depth_rows(const DepthTask& task, int64_t row_begin, int64_t row_end) {
  const vfloat one = splat(1.0f);
  for (int64_t row = row_begin; row < row_end; ++row) {
    vfloat sums{};
    for_row(task, row, [&](int64_t at, const float* depth, const float* target, const uint8_t* mask, int count) {
      const vint valid = valid_depth(depth, target, mask);
      const vfloat inverse = one / select(valid, load(depth), one);
      const vfloat d = inverse - one / select(valid, load(target), one);
      const vfloat difference = select(valid, d, vfloat{});
      const vfloat slope = task.scale * inverse * inverse;
      const vfloat gradient = select(difference > 0, -slope, select(difference < 0, slope, vfloat{}));
      sums += select(difference < 0, -difference, difference);
      if (count == kLanes) {
        store(task.gradient + at, gradient);
      } else {
        for (int lane = 0; lane < count; ++lane) task.gradient[at + lane] = gradient[lane];
      }
    });
    double total = 0;
    for (int lane = 0; lane < kLanes; ++lane) total += sums[lane];
    task.sums[row] = total;
  }
}

static int64_t count_tissue(const uint8_t* mask, int64_t pixels) {
  int64_t count = 0;
  for (int64_t i = 0; i < pixels; ++i) count += mask[i] != 0;
  return count;
}

extern const Kernels kernels = {colour_rows, count_depth_rows, depth_rows, count_tissue};

}  // namespace GSPLAT_ISA::image_loss
