// Matching costs of a plane sweep. A vector holds a pixel's labels, so that window sums slide along rows and columns.
#include "plane_vectors.h"

namespace GSPLAT_ISA::plane_sweep {
namespace {

typedef uint32_t vuint __attribute__((vector_size(kLanes * 4)));
typedef int16_t vshort __attribute__((vector_size(kLanes * 2)));
typedef uint8_t vbyte __attribute__((vector_size(kLanes)));

constexpr int kKeptRows = 8;  // at least the window's rows and the row that leaves it
constexpr int kChunk = 4;     // columns that are warped together
constexpr int kSums = 3;      // over a window: grey of the view, its square, and grey of the view times grey of the reference

// Rows around the current one of one column of a warped view.
struct Column {
  int32_t sums[kSums][kLanes];       // over the window's rows
  int16_t greys[kKeptRows][kLanes];  // grey levels of the last rows, times 2, plus 1 where the pixel is usable
};

struct Sums {
  int32_t of[kSums][kLanes];
};

// Coefficients of the homographies of one view, one label per lane.
struct Homography {
  float of[9][kLanes];
};

// Positions in a view.
struct Samples {
  float right[kLanes], down[kLanes];  // shares of the right and lower pixels
  uint32_t places[kLanes];            // of the upper left pixels
};

// Scratch of `costs`, for all views.
struct State {
  Homography* homographies;  // [views]
  Sums* windows;             // [views], of the last pixel
  Samples* samples;          // [kChunk, views]
  Column* columns;           // [width, views]
};

GSPLAT_INLINE vint widened(const int16_t* from) {
#if defined(__AVX512F__)
  return (vint)_mm512_cvtepi16_epi32(load_as<__m256i>(from));
#else
  return __builtin_convertvector(load_as<vshort>(from), vint);
#endif
}

// Entries of a view's table, as halves of 32 bits.
struct Entries {
  vuint lower, upper;
};

// Look up kLanes entries. Scalar loads are faster than gather instructions.
GSPLAT_INLINE Entries entries_at(const Corners* table, const uint32_t* places) {
#if defined(__AVX2__)
  const auto at = [&](int i) { return (long long)table[places[i]]; };
  const auto four = [&](int i) { return _mm256_set_epi64x(at(i + 3), at(i + 2), at(i + 1), at(i)); };
#endif
#if defined(__AVX512F__)
  const auto eight = [&](int i) { return (vuint)_mm512_inserti64x4(_mm512_castsi256_si512(four(i)), four(i + 4), 1); };
  const vuint a = eight(0), b = eight(8);
  return {__builtin_shufflevector(a, b, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30),
          __builtin_shufflevector(a, b, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31)};
#elif defined(__AVX2__)
  const vuint a = (vuint)four(0), b = (vuint)four(4);
  return {__builtin_shufflevector(a, b, 0, 2, 4, 6, 8, 10, 12, 14), __builtin_shufflevector(a, b, 1, 3, 5, 7, 9, 11, 13, 15)};
#else
  uint32_t lower[kLanes], upper[kLanes];
  for (int i = 0; i < kLanes; ++i) {
    const Corners corners = table[places[i]];
    lower[i] = uint32_t(corners), upper[i] = uint32_t(corners >> 32);
  }
  return {load_as<vuint>(lower), load_as<vuint>(upper)};
#endif
}

GSPLAT_INLINE vfloat to_float(vint x) { return __builtin_convertvector(x, vfloat); }

// Return 1 where the interpolated mask is above kSeen, else 0.
GSPLAT_INLINE vint seen(vint lower, vfloat right, vfloat down) {
  const vint all = splat_int(15 << kUsableShift);
  if (lanes_of(at_least(lower & all, all)) == uint32_t((uint64_t(1) << kLanes) - 1)) return splat_int(1);
  const auto at = [&](int corner) { return to_float(lower >> (kUsableShift + corner) & 1); };
  const vfloat upper_row = fma(right, at(1) - at(0), at(0)), lower_row = fma(right, at(3) - at(2), at(2));
  return where(above(fma(down, lower_row - upper_row, upper_row), splat(kSeen)), splat_int(1), vint{});
}

// Find the positions in a view of the columns [begin, end) of row y. Points behind the view's camera are outside of its picture.
GSPLAT_INLINE void locate(const Sweep& in, const Homography& h, int64_t y, int64_t begin, int64_t end, Samples* to) {
  const auto of = [&](int i) { return load(h.of[i]); };
  const vfloat row = splat(float(y)), one = splat(1.0f);
  const vfloat left = fma(of(1), row, of(2)), top = fma(of(4), row, of(5)), depth = fma(of(7), row, of(8));
  const vfloat last_x = splat(float(in.width + 1)), last_y = splat(float(in.height + 1)), stride = splat(float(in.width + 2));
  for (int64_t x = begin; x < end; ++x, to += in.count) {
    const vfloat column = splat(float(x)), z = fma(of(6), column, depth), scale = reciprocal(z);
    const vfloat u = where(above(z, vfloat{}), fma(fma(of(0), column, left), scale, one), vfloat{});
    const vfloat v = fma(fma(of(3), column, top), scale, one);
    // The border is black and unusable. NaN becomes 0.
    const vfloat inside_x = smaller(larger(u, vfloat{}), last_x), inside_y = smaller(larger(v, vfloat{}), last_y);
    const vfloat first_x = truncate(inside_x), first_y = truncate(inside_y);
    store(to->right, inside_x - first_x);
    store(to->down, inside_y - first_y);
    store_as(to->places, to_int(fma(first_y, stride, first_x)));
  }
}

// Interpolate and keep a row's samples.
GSPLAT_INLINE void keep(const Corners* table, const Samples& samples, int64_t y, Column& column) {
  const Entries entries = entries_at(table, samples.places);
  const vint lower = (vint)entries.lower, upper = (vint)entries.upper;
  const vfloat right = load(samples.right), down = load(samples.down);
  const vfloat here = to_float(lower & 255), across = to_float(lower >> 16), along = to_float((vint)(entries.upper << 16) >> 16),
               twist = to_float(upper >> 16);
  const vfloat grey = fma(down, fma(right, twist, along), fma(right, across, here));
  const vint steps = to_int(fma(grey, splat(float(kGreySteps)), splat(0.5f))) - kMiddleGrey * kGreySteps;
  store_as(column.greys[y % kKeptRows], __builtin_convertvector(steps * 2 + seen(lower, right, down), vshort));
}

// Warp the views to the columns [begin, end) of row y.
GSPLAT_INLINE void warp(const Sweep& in, const State& state, int64_t y, int64_t begin, int64_t end) {
  for (int view = 0; view < in.count; ++view) locate(in, state.homographies[view], y, begin, end, state.samples + view);
  const int64_t entries = int64_t(in.height + 2) * (in.width + 2);
  const Samples* samples = state.samples;
  Column* column = state.columns + begin * in.count;
  for (int64_t x = begin; x < end; ++x)
    for (int view = 0; view < in.count; ++view) keep(in.views + view * entries, *samples++, y, *column++);
}

// Rows of a picture, of which one enters the window and one leaves it.
struct Rows {
  int64_t enters, leaves;
};

// Move the window of a column by a row. enters and leaves: grey levels of the reference in these rows.
GSPLAT_INLINE void slide_down(const Rows& rows, int32_t enters, int32_t leaves, Column& column) {
  const vint next = widened(column.greys[rows.enters % kKeptRows]) >> 1,
             last = widened(column.greys[rows.leaves % kKeptRows]) >> 1;
  const vint change = next - last;
  store_as(column.sums[0], load_as<vint>(column.sums[0]) + change);
  store_as(column.sums[1], load_as<vint>(column.sums[1]) + change * (next + last));
  store_as(column.sums[2], load_as<vint>(column.sums[2]) + (next * enters - last * leaves));
}

// Start the sums of a column at row 0.
GSPLAT_INLINE void start(const Sweep& in, int64_t x, Column& column) {
  vint sums[kSums] = {};
  for (int k = -kRadius; k <= kRadius; ++k) {
    const int64_t y = reflected(k, in.height);
    const vint grey = widened(column.greys[y % kKeptRows]) >> 1;
    sums[0] += grey, sums[1] += grey * grey, sums[2] += grey * (in.reference[y * in.width + x] - kMiddleGrey);
  }
  for (int i = 0; i < kSums; ++i) store_as(column.sums[i], sums[i]);
}

// Move the windows of the columns [begin, end) to row y.
GSPLAT_INLINE void slide_columns(const Sweep& in, const State& state, int64_t y, int64_t begin, int64_t end) {
  const Rows rows = {reflected(y + kRadius, in.height), reflected(y - kRadius - 1, in.height)};
  Column* column = state.columns + begin * in.count;
  for (int64_t x = begin; x < end; ++x)
    for (int view = 0; view < in.count; ++view, ++column) {
      if (y == 0)
        start(in, x, *column);
      else
        slide_down(rows, in.reference[rows.enters * in.width + x] - kMiddleGrey,
                   in.reference[rows.leaves * in.width + x] - kMiddleGrey, *column);
    }
}

// Columns that enter and leave the windows of all views.
struct Columns {
  const Column *enters, *leaves;
};

// Return the columns of pixel x. At pixel 0, where the windows start, none enters or leaves.
GSPLAT_INLINE Columns around(const Sweep& in, const State& state, int64_t x) {
  const int64_t enters = x > 0 ? x + kRadius : 0, leaves = x > 0 ? x - kRadius - 1 : 0;
  return {state.columns + reflected(enters, in.width) * in.count, state.columns + reflected(leaves, in.width) * in.count};
}

// Sum the windows of pixel 0.
GSPLAT_INLINE void start_windows(const Sweep& in, const State& state) {
  for (int view = 0; view < in.count; ++view)
    for (int i = 0; i < kSums; ++i) {
      vint sum = {};
      for (int k = -kRadius; k <= kRadius; ++k)
        sum += load_as<vint>(state.columns[reflected(k, in.width) * in.count + view].sums[i]);
      store_as(state.windows[view].of[i], sum);
    }
}

// Move the window of a view by a column.
GSPLAT_INLINE vint slide_right(Sums& window, const Column& enters, const Column& leaves, int i) {
  const vint sum = load_as<vint>(window.of[i]) + (load_as<vint>(enters.sums[i]) - load_as<vint>(leaves.sums[i]));
  store_as(window.of[i], sum);
  return sum;
}

// Return the correlation of a view with the reference. The numerator is exact, both are multiplied by kWindow².
GSPLAT_INLINE vfloat correlation(const vint* sums, int32_t reference, float contrast) {
  const vint covariance = sums[2] * kWindow - sums[0] * reference;
  const vfloat grey = __builtin_convertvector(sums[0], vfloat), square = __builtin_convertvector(sums[1], vfloat);
  const vfloat variance = larger(fma(square, splat(float(kWindow)), -grey * grey), vfloat{});
  const float noise = kNoiseGrey * kNoiseGrey * kGreySteps * kGreySteps * kWindow * kWindow;
  return __builtin_convertvector(covariance, vfloat) * contrast * inverse_root(variance + noise);
}

// Move the windows to a pixel and compute its costs.
GSPLAT_INLINE void match(const Sweep& in, const State& state, int64_t first, int64_t x, int64_t y, const Volume& out) {
  const int64_t pixel = y * in.width + x;
  const Column* const here = state.columns + x * in.count;
  const Columns columns = around(in, state, x);
  vfloat total = {};
  vint views = {}, agreeing = {};
  for (int view = 0; view < in.count; ++view) {
    vint sums[kSums];
    for (int i = 0; i < kSums; ++i) sums[i] = slide_right(state.windows[view], columns.enters[view], columns.leaves[view], i);
    if (!(in.contrast[pixel] > 0)) continue;
    const vint usable = widened(here[view].greys[y % kKeptRows]) & 1;
    const vfloat similar = correlation(sums, in.sums[pixel], in.contrast[pixel]);
    total = total + zero_unless(at_least(usable, splat_int(1)), larger(similar, vfloat{}));
    views = views + usable;
    agreeing = agreeing + where(above(similar, splat(kAgrees)), usable, vint{});
  }
  const vfloat mean = total / larger(__builtin_convertvector(views, vfloat), splat(1.0f));
  const vint costs = to_int(larger(fma(mean, splat(-float(kDisagrees)), splat(kDisagrees + 0.5f)), vfloat{}));
  int16_t cost[kLanes];
  uint8_t votes[kLanes];
  const int64_t at = pixel * in.labels + first, count = in.labels - first;
  const bool whole = count >= kLanes;
  store_as(whole ? out.costs + at : cost, __builtin_convertvector(costs, vshort));
  store_as(whole ? out.votes + at : votes, __builtin_convertvector(agreeing, vbyte));
  for (int64_t i = 0; i < (whole ? 0 : count); ++i) out.costs[at + i] = cost[i], out.votes[at + i] = votes[i];
}

int64_t cost_scratch(const Sweep& in) {
  return in.count * int64_t(in.width * sizeof(Column) + kChunk * sizeof(Samples) + sizeof(Sums) + sizeof(Homography));
}

void costs(const Sweep& given, int64_t first, uint8_t* scratch, const Volume& to) {
  const Sweep in = given;  // copies, which no store can change
  const Volume out = to;
  State state;
  state.homographies = reinterpret_cast<Homography*>(scratch);
  state.windows = reinterpret_cast<Sums*>(state.homographies + in.count);
  state.samples = reinterpret_cast<Samples*>(state.windows + in.count);
  state.columns = reinterpret_cast<Column*>(state.samples + kChunk * in.count);
  for (int view = 0; view < in.count; ++view)
    for (int lane = 0; lane < kLanes; ++lane) {  // the last block repeats the last label
      const float* const from = in.homographies + (less(first + lane, int64_t(in.labels) - 1) * in.count + view) * 9;
      for (int i = 0; i < 9; ++i) state.homographies[view].of[i][lane] = from[i];
    }
  for (int64_t y = 0; y < in.height; ++y) {
    int64_t next = 0;  // pixel, whose window ends kRadius columns later
    for (int64_t begin = 0; begin < in.width; begin += kChunk) {
      const int64_t end = less(begin + kChunk, int64_t(in.width));
      // Row 0 needs all rows of its window, each later row one more.
      for (int64_t row = y > 0 ? y + kRadius : 0; row <= less(y + kRadius, int64_t(in.height) - 1); ++row)
        warp(in, state, row, begin, end);
      slide_columns(in, state, y, begin, end);
      for (const int64_t until = end == in.width ? end : end - kRadius; next < until; ++next) {
        if (next == 0) start_windows(in, state);
        match(in, state, first, next, y, out);
      }
    }
  }
}

}  // namespace

extern const Kernels kernels = {kLanes, cost_scratch, costs, label_scratch, labels};

}  // namespace GSPLAT_ISA::plane_sweep
