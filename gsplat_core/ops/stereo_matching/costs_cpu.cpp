// What each disparity costs at each pixel: differences of single pixels, then their sums over a window, row by row.
#include "byte_rows.h"

namespace GSPLAT_ISA::stereo_matching {
namespace {

constexpr int kKeptRows = kWindowSide + 1;  // those of the window, and the one that leaves it

// A row of one picture: values, and their range half a pixel to both sides.
struct Range {
  uint8_t *value, *low, *high;
};
struct Row {
  Range slope, brightness;
};

GSPLAT_INLINE uint8_t* take(uint8_t*& scratch, int64_t bytes) {
  uint8_t* const taken = scratch;
  scratch += bytes;
  return taken;
}

GSPLAT_INLINE Row take_row(uint8_t*& scratch, int64_t size) {
  uint8_t* each[6];
  for (auto& one : each) one = take(scratch, size);
  return {{each[0], each[1], each[2]}, {each[3], each[4], each[5]}};
}

// The range of values of a row at a column.
GSPLAT_INLINE void put_range(const uint8_t* row, int64_t width, int64_t column, const Range& to, int64_t at) {
  const int here = row[column], before = (here + row[within(column - 1, width)]) / 2,
            after = (here + row[within(column + 1, width)]) / 2;
  to.value[at] = uint8_t(here);
  to.low[at] = uint8_t(less(here, less(before, after)));
  to.high[at] = uint8_t(more(here, more(before, after)));
}

// A row of `picture`: column(at) is which one is wanted at `at`. slopes: [width].
template <class Column>
GSPLAT_INLINE void fill_row(const Pair& pair, const uint8_t* picture, int64_t y, const Row& to, int64_t size, uint8_t* slopes,
                            const Column& column) {
  const int64_t width = pair.width;
  const uint8_t* const here = picture + y * width;
  const uint8_t* const above = picture + within(y - 1, pair.height) * width;
  const uint8_t* const below = picture + within(y + 1, pair.height) * width;
  for (int64_t x = 0; x < width; ++x) {
    const int64_t l = within(x - 1, width), r = within(x + 1, width);
    const int slope = 2 * (here[r] - here[l]) + above[r] - above[l] + below[r] - below[l];
    slopes[x] = uint8_t(less(more(slope, -kSlopeCap), kSlopeCap) + kSlopeCap);
  }
  for (int64_t at = 0; at < size; ++at) {
    put_range(slopes, width, column(at), to.slope, at);
    put_range(here, width, column(at), to.brightness, at);
  }
}

GSPLAT_INLINE uint8_t beyond(uint8_t a, uint8_t b) { return uint8_t(more(a, b) - b); }

// How far a value is out of the other one's range, the lesser of both ways.
GSPLAT_INLINE uint8_t difference(uint8_t a, uint8_t a_low, uint8_t a_high, uint8_t b, uint8_t b_low, uint8_t b_high) {
  return less(more(beyond(a, b_high), beyond(b_low, a)), more(beyond(b, a_high), beyond(a_low, b)));
}

// Differences of a row's pixels [width, count]. What matches column x with disparity number d is in `right` at width - 1 - x + d.
template <int kWide>
GSPLAT_INLINE void pixel_costs(const Row& left, const Row& right, int64_t width, int count, uint8_t* __restrict costs) {
  for (int64_t x = 0; x < width; ++x) {
    const uint8_t s = left.slope.value[x], s_low = left.slope.low[x], s_high = left.slope.high[x];
    const uint8_t b = left.brightness.value[x], b_low = left.brightness.low[x], b_high = left.brightness.high[x];
    for (int first = 0; first < count; first += kWide) {
      const int64_t at = width - 1 - x + first;
      const Range slope = {right.slope.value + at, right.slope.low + at, right.slope.high + at};
      const Range brightness = {right.brightness.value + at, right.brightness.low + at, right.brightness.high + at};
      uint8_t* __restrict const to = costs + x * count + first;
      for (int i = 0; i < kWide; ++i) {
        const uint8_t by_slope = difference(s, s_low, s_high, slope.value[i], slope.low[i], slope.high[i]);
        const uint8_t by_brightness = difference(b, b_low, b_high, brightness.value[i], brightness.low[i], brightness.high[i]);
        to[i] = uint8_t(by_slope + less(by_brightness, uint8_t(kBrightnessMost)));
      }
    }
  }
}

// Sums of columns [width, count] to sums over the window.
template <int kWide>
GSPLAT_INLINE void window_costs(const uint16_t* __restrict columns, int64_t width, int count, uint8_t* __restrict costs) {
  for (int first = 0; first < count; first += kWide) {
    uint16_t sum[kWide] = {};
    for (int64_t x = -kWindowRadius; x <= kWindowRadius; ++x) {
      const uint16_t* const enters = columns + within(x, width) * count + first;
      for (int i = 0; i < kWide; ++i) sum[i] = uint16_t(sum[i] + enters[i]);
    }
    for (int64_t x = 0; x < width; ++x) {
      const uint16_t* const enters = columns + within(x + kWindowRadius + 1, width) * count + first;
      const uint16_t* const leaves = columns + within(x - kWindowRadius, width) * count + first;
      uint8_t* const to = costs + x * count + first;
      for (int i = 0; i < kWide; ++i) {
        to[i] = uint8_t(less(uint16_t(sum[i] >> kCostShift), uint16_t(kMostCost)));
        sum[i] = uint16_t(sum[i] + enters[i] - leaves[i]);
      }
    }
  }
}

}  // namespace

int64_t cost_scratch(const Pair& pair) {
  const int64_t width = pair.width, row = width * pair.count;
  return 7 * width + 6 * (width + pair.count) + (kKeptRows + 2) * row + 64;
}

void sum_costs(const Pair& pair, uint8_t* costs, int64_t begin, int64_t end, uint8_t* scratch) {
  const int64_t width = pair.width, height = pair.height, row = width * pair.count;
  uint16_t* const columns =
      reinterpret_cast<uint16_t*>((reinterpret_cast<uintptr_t>(take(scratch, 2 * row + 64)) + 63) / 64 * 64);
  uint8_t* const kept = take(scratch, kKeptRows * row);
  const int64_t reversed = width - 1 + pair.count;
  const Row left = take_row(scratch, width), right = take_row(scratch, reversed);
  uint8_t* const slopes = take(scratch, width);
  const auto pixels_of = [&](int64_t y) { return kept + y % kKeptRows * row; };
  const auto add_row = [&](int64_t y) {
    fill_row(pair, pair.left, y, left, width, slopes, [](int64_t at) { return at; });
    fill_row(pair, pair.right, y, right, reversed, slopes,
             [&](int64_t at) { return within(width - 1 - pair.lowest - at, width); });
    with_width(pair.count, [&](auto wide) { pixel_costs<decltype(wide)::value>(left, right, width, pair.count, pixels_of(y)); });
  };
  const int64_t top = within(begin - kWindowRadius, height), bottom = within(begin + kWindowRadius, height);
  for (int64_t y = top; y <= bottom; ++y) add_row(y);
  for (int64_t i = 0; i < row; ++i) columns[i] = 0;
  for (int64_t y = begin - kWindowRadius; y <= begin + kWindowRadius; ++y) {
    const uint8_t* __restrict const pixels = pixels_of(within(y, height));
    for (int64_t i = 0; i < row; ++i) columns[i] = uint16_t(columns[i] + pixels[i]);
  }
  for (int64_t y = begin; y < end; ++y) {
    with_width<kMostWide / 2>(
        pair.count, [&](auto wide) { window_costs<decltype(wide)::value>(columns, width, pair.count, costs + y * row); });
    if (y + 1 == end) break;
    if (y + 1 + kWindowRadius < height) add_row(y + 1 + kWindowRadius);
    const uint8_t* __restrict const enters = pixels_of(within(y + 1 + kWindowRadius, height));
    const uint8_t* __restrict const leaves = pixels_of(within(y - kWindowRadius, height));
    for (int64_t i = 0; i < row; ++i) columns[i] = uint16_t(columns[i] + enters[i] - leaves[i]);
  }
}

}  // namespace GSPLAT_ISA::stereo_matching
