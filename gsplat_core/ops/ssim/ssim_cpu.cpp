// One pass over the rows. A ring of 11 input rows gives the four moments of a row (vertical, then horizontal filter).
// The moments give the similarity and its derivatives with respect to them. A second ring of 11 filtered derivative
// rows gives the gradient, 5 rows behind. Channels stay interleaved: a horizontal neighbour is `channels` floats away.
#include "simd.h"
#include "ssim.h"

namespace GSPLAT_ISA::ssim {

using namespace gsplat::ssim;

constexpr float kC1 = 0.01f * 0.01f;
constexpr float kC2 = 0.03f * 0.03f;
constexpr int R = kSsimRadius;
constexpr int T = kSsimTaps;
constexpr int64_t S = kSsimStride;

GSPLAT_INLINE int slot_of(int64_t row) { return int((row + 10 * T) % T); }  // rows start at -10

struct Strip {
  const SsimTask& task;
  int64_t first_px;  // first pixel of the strip without its halo
  int64_t pixels;    // pixels of the strip without its halo
  // Column 0 of every buffered row is pixel first_px - 2R of the image.
  float* image;       // ring [T][S]
  float* target;      // ring
  float* tissue;      // ring, 0 or 1
  float* blurred;     // three rings: derivatives with respect to mean, squares and product, filtered horizontally
  float* moments;     // 4 rows, filtered vertically: means of x, y, x^2 + y^2, xy
  float* derivative;  // 3 rows
  float* similarity;  // 1 row
  float* upstream;    // 1 row

  int begin(int halo_px) const { return (2 * R - halo_px) * task.channels; }
  int end(int halo_px) const { return int(2 * R + pixels + halo_px) * task.channels; }
};

static void fill(float* to, int64_t n, float value) {
  for (int64_t i = 0; i < n; ++i) to[i] = value;
}

// Expand a pixel's mask byte to each of its channels, as 0 or 1.
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
  for (int64_t p = 0; p < pixels; ++p) fill(to + p * channels, channels, mask[p] ? 1.0f : 0.0f);
}

// Load one row of both images into the rings; 0 outside of the image and where there is no tissue.
static void load_row(const Strip& s, int64_t row) {
  const SsimTask& task = s.task;
  const int64_t at = slot_of(row) * S;
  float *x = s.image + at, *y = s.target + at, *m = s.tissue + at;
  if (row < 0 || row >= task.height) {
    fill(x, S, 0);
    fill(y, S, 0);
    fill(m, S, 0);
    return;
  }
  const int c = task.channels;
  const int64_t left = s.first_px - 2 * R, right = s.first_px + s.pixels + 2 * R;
  const int64_t from = left < 0 ? 0 : left, to = right > task.width ? task.width : right;
  const int64_t lead = (from - left) * c, n = (to - from) * c;
  const int64_t source = (row * task.width + from) * c;
  float* rings[] = {x, y, m};
  for (float* ring : rings) {
    fill(ring, lead, 0);
    fill(ring + lead + n, S - lead - n, 0);
  }
  x += lead, y += lead, m += lead;
  if (task.mask)
    expand_mask(m, task.mask + row * task.width + from, to - from, c);
  else
    fill(m, n, 1);
  // The mask selects instead of multiplying, so that NaN outside of tissue does not spread.
  const float* image = task.image + source;
  for (int64_t i = 0; i < n; ++i) x[i] = m[i] > 0 ? image[i] : 0;
  if (task.target_bytes) {
    const uint8_t* target = task.target_bytes + source;
    for (int64_t i = 0; i < n; ++i) y[i] = m[i] > 0 ? float(target[i]) / 255.0f : 0;
  } else {
    const float* target = task.target + source;
    for (int64_t i = 0; i < n; ++i) y[i] = m[i] > 0 ? target[i] : 0;
  }
}

// Reorder the taps by ring slot for the window around `row`, so that a ring is read sequentially.
static void rotate_taps(float* rotated, const float* taps, int64_t row) {
  for (int k = 0; k < T; ++k) rotated[slot_of(row + k - R)] = taps[k];
}

static void vertical_moments(const Strip& s, int64_t row) {
  float taps[T];
  rotate_taps(taps, s.task.taps, row);
  vfloat w[T];
  for (int k = 0; k < T; ++k) w[k] = splat(taps[k]);
  const float *images = s.image, *targets = s.target;
  float* moments = s.moments;
  for (int e = s.begin(2 * R), last = s.end(2 * R); e < last; e += kLanes) {
    vfloat mean_x{}, mean_y{}, squares{}, product{};
#pragma GCC unroll 11
    for (int k = 0; k < T; ++k) {
      const vfloat x = load(images + k * S + e), y = load(targets + k * S + e);
      mean_x += w[k] * x;
      mean_y += w[k] * y;
      squares += w[k] * (x * x + y * y);
      product += w[k] * (x * y);
    }
    store(moments + e, mean_x);
    store(moments + S + e, mean_y);
    store(moments + 2 * S + e, squares);
    store(moments + 3 * S + e, product);
  }
}

GSPLAT_INLINE vfloat filter_row(const float* at, const vfloat* w, int channels) {
  vfloat sum = w[R] * load(at);
#pragma GCC unroll 5
  for (int k = 1; k <= R; ++k) sum += w[R + k] * (load(at - k * channels) + load(at + k * channels));
  return sum;
}

// Compute the similarity S = A1 A2 / (B1 B2) of one row, and its derivatives with respect to mean of x, squares and
// product, times the pixel's weight.
static void similarity_row(const Strip& s, int64_t row, int halo_px) {
  const SsimTask& task = s.task;
  const int c = task.channels;
  vfloat w[T];
  for (int k = 0; k < T; ++k) w[k] = splat(task.taps[k]);
  const float* tissue = s.tissue + slot_of(row) * S;
  const bool derive = task.gradient != nullptr;
  const float scale = task.scale;
  const float *moments = s.moments, *upstream = s.upstream;
  float *derivative = s.derivative, *similarities = s.similarity;
  for (int e = s.begin(halo_px), last = s.end(halo_px); e < last; e += kLanes) {
    const vfloat a = filter_row(moments + e, w, c), b = filter_row(moments + S + e, w, c);
    const vfloat squares = filter_row(moments + 2 * S + e, w, c), product = filter_row(moments + 3 * S + e, w, c);
    const vfloat ab = a * b, means = a * a + b * b;
    const vfloat a1 = 2.0f * ab + kC1, a2 = 2.0f * (product - ab) + kC2;
    const vfloat b1 = means + kC1, b2 = squares - means + kC2;
    const vfloat inverse = 1.0f / (b1 * b2);
    const vfloat similarity = a1 * a2 * inverse;
    store(similarities + e, similarity);
    if (!derive) continue;
    const vfloat weight = scale * load(tissue + e) * load(upstream + e);
    const vfloat by_b1 = b2 * inverse, by_b2 = b1 * inverse;
    store(derivative + e, weight * 2.0f * (b * (a2 - a1) * inverse - a * similarity * (by_b1 - by_b2)));
    store(derivative + S + e, -weight * similarity * by_b2);
    store(derivative + 2 * S + e, weight * 2.0f * a1 * inverse);
  }
}

static void blur_derivatives(const Strip& s, int64_t row) {
  vfloat w[T];
  for (int k = 0; k < T; ++k) w[k] = splat(s.task.taps[k]);
  for (int d = 0; d < 3; ++d) {
    float* to = s.blurred + (d * T + slot_of(row)) * S;
    const float* from = s.derivative + d * S;
    const int channels = s.task.channels;
    for (int e = s.begin(0), last = s.end(0); e < last; e += kLanes) store(to + e, filter_row(from + e, w, channels));
  }
}

// dL/dx = G * dL/dmean + 2 x (G * dL/dsquares) + y (G * dL/dproduct), where G is the symmetric filter.
static void add_gradient_row(const Strip& s, int64_t row) {
  float taps[T];
  rotate_taps(taps, s.task.taps, row);
  vfloat w[T];
  for (int k = 0; k < T; ++k) w[k] = splat(taps[k]);
  const int64_t at = slot_of(row) * S;
  const int first = s.begin(0), last = s.end(0);
  const float *image = s.image + at, *target = s.target + at, *tissue = s.tissue + at, *blurred = s.blurred;
  float* out = s.task.gradient + (row * s.task.width + s.first_px) * s.task.channels - first;
  for (int e = first; e < last; e += kLanes) {
    vfloat by_mean{}, by_squares{}, by_product{};
#pragma GCC unroll 11
    for (int k = 0; k < T; ++k) {
      by_mean += w[k] * load(blurred + k * S + e);
      by_squares += w[k] * load(blurred + (T + k) * S + e);
      by_product += w[k] * load(blurred + (2 * T + k) * S + e);
    }
    const vfloat x = load(image + e), y = load(target + e), m = load(tissue + e);
    const vfloat gradient = m * (by_mean + 2.0f * x * by_squares + y * by_product);
    if (e + kLanes <= last) {
      store(out + e, load(out + e) + gradient);
    } else {
      for (int lane = 0; e + lane < last; ++lane) out[e + lane] += gradient[lane];
    }
  }
}

static void load_upstream(const Strip& s, int64_t row) {
  const SsimTask& task = s.task;
  const int c = task.channels;
  const int64_t left = s.first_px - 2 * R, right = s.first_px + s.pixels + 2 * R;
  const int64_t from = left < 0 ? 0 : left, to = right > task.width ? task.width : right;
  fill(s.upstream, S, 0);
  const float* source = task.upstream + (row * task.width + from) * c;
  float* out = s.upstream + (from - left) * c;
  for (int64_t i = 0; i < (to - from) * c; ++i) out[i] = source[i];
}

// Set the weights of a row to 1 where its pixels count, and to 0 in the border.
static void weigh_inner(const Strip& s, int64_t row) {
  const SsimTask& task = s.task;
  fill(s.upstream, S, 0);
  if (row < task.border || row >= task.height - task.border) return;
  const int64_t left = s.first_px - 2 * R, right = s.first_px + s.pixels + 2 * R;
  const int64_t from = left < task.border ? task.border : left, inner = task.width - task.border;
  const int64_t to = right > inner ? inner : right;
  fill(s.upstream + (from - left) * task.channels, (to - from) * task.channels, 1);
}

// Write the sum and the similarities of a row, if the row belongs to the band that this task computes.
static void emit_row(const Strip& s, int64_t strip, int64_t row) {
  const SsimTask& task = s.task;
  const int first = s.begin(0), last = s.end(0);
  if (task.sums) {
    const float* tissue = s.tissue + slot_of(row) * S;
    const bool inside = row >= task.border && row < task.height - task.border;
    const int64_t before = task.border - s.first_px, inner = task.width - task.border - s.first_px;
    const int end = inside ? first + int(inner < s.pixels ? inner : s.pixels) * task.channels : 0;
    vfloat sums{};
    int e = first + int(before > 0 ? before : 0) * task.channels;
    for (; e + kLanes <= end; e += kLanes) sums += load(tissue + e) * (1.0f - load(s.similarity + e));
    double total = 0;
    for (int lane = 0; lane < kLanes; ++lane) total += sums[lane];
    for (; e < end; ++e) total += tissue[e] * (1.0f - s.similarity[e]);
    task.sums[row * ssim_strips(task.width, task.channels) + strip] = total;
  }
  if (task.map) {
    float* out = task.map + (row * task.width + s.first_px) * task.channels - first;
    for (int e = first; e < last; ++e) out[e] = s.similarity[e];
  }
}

static void band(const SsimTask& task, int64_t strip, int64_t row_begin, int64_t row_end, float* scratch) {
  const int64_t strip_px = ssim_strip_px(task.channels), first_px = strip * strip_px;
  const int64_t pixels = task.width - first_px < strip_px ? task.width - first_px : strip_px;
  float* rows = scratch + 6 * T * S;
  const Strip s{task, first_px,     pixels,       scratch,     scratch + T * S, scratch + 2 * T * S, scratch + 3 * T * S,
                rows, rows + 4 * S, rows + 7 * S, rows + 8 * S};
  fill(rows, 9 * S, 0);
  fill(s.upstream, S, 1);
  const bool derive = task.gradient != nullptr;
  const int64_t halo = derive ? R : 0;
  for (int64_t row = row_begin - halo - R; row < row_begin - halo + R; ++row) load_row(s, row);
  for (int64_t row = row_begin - halo; row < row_end + halo; ++row) {
    load_row(s, row + R);
    if (row >= 0 && row < task.height) {
      if (task.upstream)
        load_upstream(s, row);
      else if (task.border > 0)
        weigh_inner(s, row);
      vertical_moments(s, row);
      similarity_row(s, row, int(halo));
      if (row >= row_begin && row < row_end) emit_row(s, strip, row);
      if (derive) blur_derivatives(s, row);
    } else {
      for (int d = 0; d < 3; ++d) fill(s.blurred + (d * T + slot_of(row)) * S, S, 0);
    }
    if (derive && row - R >= row_begin) add_gradient_row(s, row - R);
  }
}

extern const Kernels kernels = {band};

}  // namespace GSPLAT_ISA::ssim
