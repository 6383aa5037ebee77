// Matching costs of every disparity at every pixel: pixel differences, then their sums over a window, row by row.
#include "disparity_vectors.h"

namespace GSPLAT_ISA::stereo_matching {
namespace {

constexpr int kKeptRows = kWindowSide + 1;  // the window's rows, and the row that leaves it

// A row of one image: values, and their range within half a pixel to both sides.
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

// Copy a row of values; write the smallest and the largest of each value and its means with both neighbours.
GSPLAT_INLINE void fill_range(const uint8_t* values, int64_t width, const Range& to) {
  const auto fill = [&](int64_t x, int64_t l, int64_t r) {
    const int here = values[x], before = (here + values[l]) >> 1, after = (here + values[r]) >> 1;
    to.value[x] = uint8_t(here);
    to.low[x] = uint8_t(less(here, less(before, after)));
    to.high[x] = uint8_t(more(here, more(before, after)));
  };
  fill(0, 0, within(1, width));
  for (int64_t x = 1; x < width - 1; ++x) fill(x, x - 1, x + 1);
  if (width > 1) fill(width - 1, width - 2, width - 1);
}

// Compute slope and brightness of row `y` with their ranges (`fill_range`). slopes: scratch of `width` values.
GSPLAT_INLINE void fill_row(const Pair& pair, const uint8_t* picture, int64_t y, const Row& to, uint8_t* slopes) {
  const int64_t width = pair.width;
  const uint8_t* const here = picture + y * width;
  const uint8_t* const above = picture + within(y - 1, pair.height) * width;
  const uint8_t* const below = picture + within(y + 1, pair.height) * width;
  const auto fill = [&](int64_t x, int64_t l, int64_t r) {
    const int slope = 2 * (here[r] - here[l]) + above[r] - above[l] + below[r] - below[l];
    slopes[x] = uint8_t(less(more(slope, -kSlopeCap), kSlopeCap) + kSlopeCap);
  };
  fill(0, 0, within(1, width));
  for (int64_t x = 1; x < width - 1; ++x) fill(x, x - 1, x + 1);
  if (width > 1) fill(width - 1, width - 2, width - 1);
  fill_range(slopes, width, to.slope);
  fill_range(here, width, to.brightness);
}

// Mirror the right row: the match of column x at disparity number d is stored at width - 1 - x + d, so that disparities
// are contiguous.
GSPLAT_INLINE void reverse(const Pair& pair, const Range& from, const Range& to) {
  const int64_t last = int64_t(pair.width) - 1 - pair.lowest;
  for (int64_t at = 0; at < pair.width - 1 + pair.count; ++at) {
    const int64_t x = within(last - at, pair.width);
    to.value[at] = from.value[x], to.low[at] = from.low[x], to.high[at] = from.high[x];
  }
}

// Return the Birchfield-Tomasi difference of two pixels: the smaller of the distances of each value from the other's
// range.
template <class Bytes>
GSPLAT_INLINE Bytes difference(const Range& left, int64_t x, const Range& right, int64_t at) {
  const auto here = [&](const uint8_t* row) { return Bytes{} + row[x]; };
  const auto there = [&](const uint8_t* row) { return load_as<Bytes>(row + at); };
  const auto beyond = [](Bytes a, Bytes b) { return more(a, b) - b; };
  const Bytes a = here(left.value), b = there(right.value);
  const Bytes from_left = more(beyond(a, there(right.high)), beyond(there(right.low), a));
  return less(from_left, more(beyond(b, here(left.high)), beyond(here(left.low), b)));
}

// Compute the matching costs [width, count] of a row's pixels: differences of slope and (bounded) of brightness.
template <int kWide>
GSPLAT_INLINE void pixel_costs(const Row& left, const Row& right, int64_t width, int count, uint8_t* costs) {
  using Bytes = typename Vector<kWide>::Bytes;
  for (int64_t x = 0; x < width; ++x) {
    for (int d = 0; d < count; d += kWide) {
      const int64_t at = width - 1 - x + d;
      const Bytes brightness = difference<Bytes>(left.brightness, x, right.brightness, at);
      const Bytes most = less(brightness, Bytes{} + uint8_t(kBrightnessMost));
      store_as(costs + x * count + d, difference<Bytes>(left.slope, x, right.slope, at) + most);
    }
  }
}

// Add the pixels of one row to the column sums [width, count], and subtract those of another row.
template <int kWide>
GSPLAT_INLINE void move_down(const uint8_t* enters, const uint8_t* leaves, int64_t size, uint16_t* columns) {
  using Bytes = typename Vector<kWide>::Bytes;
  using Words = typename Vector<kWide>::Words;
  for (int64_t i = 0; i < size; i += kWide) {
    Words sum = load_as<Words>(columns + i) + __builtin_convertvector(load_as<Bytes>(enters + i), Words);
    if (leaves != nullptr) sum -= __builtin_convertvector(load_as<Bytes>(leaves + i), Words);
    store_as(columns + i, sum);
  }
}

// Sum the column sums [width, count] over the window's width and convert them to costs.
template <int kWide>
GSPLAT_INLINE void window_costs(const uint16_t* columns, int64_t width, int count, uint8_t* costs) {
  using Bytes = typename Vector<kWide>::Bytes;
  using Words = typename Vector<kWide>::Words;
  for (int d = 0; d < count; d += kWide) {
    const auto column = [&](int64_t x) { return load_as<Words>(columns + within(x, width) * count + d); };
    Words sum = {};
    for (int64_t x = -kWindowRadius; x <= kWindowRadius; ++x) sum += column(x);
    for (int64_t x = 0; x < width; ++x) {
      const Words cost = less(sum >> kCostShift, Words{} + uint16_t(kMostCost));
      store_as(costs + x * count + d, __builtin_convertvector(cost, Bytes));
      sum += column(x + kWindowRadius + 1) - column(x - kWindowRadius);
    }
  }
}

}  // namespace

int64_t cost_scratch(const Pair& pair) {
  const int64_t width = pair.width, row = width * pair.count;
  return 2 * row + kKeptRows * row + 13 * width + 6 * (width + pair.count);
}

void sum_costs(const Pair& pair, uint8_t* costs, int64_t begin, int64_t end, uint8_t* scratch) {
  const int64_t width = pair.width, height = pair.height, row = width * pair.count;
  uint16_t* const columns = reinterpret_cast<uint16_t*>(take(scratch, 2 * row));
  uint8_t* const kept = take(scratch, kKeptRows * row);
  const Row left = take_row(scratch, width), ahead = take_row(scratch, width), right = take_row(scratch, width + pair.count);
  uint8_t* const slopes = take(scratch, width);
  const auto pixels_of = [&](int64_t y) { return kept + within(y, height) % kKeptRows * row; };
  const auto make_row = [&](int64_t y) {
    fill_row(pair, pair.left, y, left, slopes);
    fill_row(pair, pair.right, y, ahead, slopes);
    reverse(pair, ahead.slope, right.slope);
    reverse(pair, ahead.brightness, right.brightness);
    with_width<kRegisterBytes>(
        pair.count, [&](auto wide) { pixel_costs<decltype(wide)::value>(left, right, width, pair.count, pixels_of(y)); });
  };
  const auto move = [&](int64_t enters, const uint8_t* leaves) {
    with_width<kRegisterBytes / 2>(pair.count,
                                   [&](auto wide) { move_down<decltype(wide)::value>(pixels_of(enters), leaves, row, columns); });
  };
  for (int64_t i = 0; i < row; ++i) columns[i] = 0;
  for (int64_t y = within(begin - kWindowRadius, height); y <= within(begin + kWindowRadius, height); ++y) make_row(y);
  for (int64_t y = begin - kWindowRadius; y <= begin + kWindowRadius; ++y) move(y, nullptr);
  for (int64_t y = begin; y < end; ++y) {
    with_width<kRegisterBytes / 2>(
        pair.count, [&](auto wide) { window_costs<decltype(wide)::value>(columns, width, pair.count, costs + y * row); });
    if (y + 1 == end) break;
    if (y + 1 + kWindowRadius < height) make_row(y + 1 + kWindowRadius);
    move(y + 1 + kWindowRadius, pixels_of(y - kWindowRadius));
  }
}

}  // namespace GSPLAT_ISA::stereo_matching
