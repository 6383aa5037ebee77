// Aggregates the costs along the paths in rows and columns.
#include "disparity_vectors.h"

namespace GSPLAT_ISA::stereo_matching {
namespace {

constexpr int kMargin = 16;  // padding in bytes before and after a pixel's entries, read for disparities out of range

// State of a path per pixel: the cost of each disparity above the best one, at most kLargeStep.
struct Kept {
  uint8_t* bytes;
  int count;
  GSPLAT_METHOD uint8_t* of(int64_t pixel) const { return bytes + pixel * stride(count) + kMargin; }
  static GSPLAT_METHOD int64_t stride(int count) { return count + 2 * kMargin; }
  static GSPLAT_METHOD int64_t size(int64_t pixels, int count) { return pixels * stride(count); }
  // Start a path: every disparity costs the same, and disparities out of range are excluded.
  GSPLAT_METHOD void begin(int64_t pixel) const {
    uint8_t* const all = of(pixel) - kMargin;
    for (int i = 0; i < stride(count); ++i) all[i] = i < kMargin || i >= kMargin + count ? kLargeStep : 0;
  }
};

// Advance a path by one pixel. With kFirst it stores its messages there, else it adds them to those of earlier paths.
template <int kWide, bool kFirst>
GSPLAT_INLINE void step(const uint8_t* before, const uint8_t* costs, int count, uint8_t* after, uint8_t* messages) {
  using Bytes = typename Vector<kWide>::Bytes;
  uint8_t totals[kMostDisparities];
  Bytes least = Bytes{} + uint8_t(255);
  for (int d = 0; d < count; d += kWide) {
    const Bytes beside = less(load_as<Bytes>(before + d - 1), load_as<Bytes>(before + d + 1)) + uint8_t(kSmallStep);
    const Bytes message = less(load_as<Bytes>(before + d), beside), total = load_as<Bytes>(costs + d) + message;
    store_as(messages + d, kFirst ? message : load_as<Bytes>(messages + d) + message);
    store_as(totals + d, total);
    least = less(least, total);
  }
  const uint8_t best = least_byte(least);
  for (int d = 0; d < count; d += kWide)
    store_as(after + d, less(load_as<Bytes>(totals + d) - best, Bytes{} + uint8_t(kLargeStep)));
}

// Advance the rightward and the leftward path of a row alternately, so that their dependency chains overlap. At each
// pixel, the path that arrives first stores its messages, and the other one adds its own to them.
template <int kWide>
GSPLAT_INLINE void along_row(const uint8_t* costs, uint8_t* messages, int64_t width, int count, const Kept& kept) {
  for (int64_t pixel = 0; pixel < 4; ++pixel) kept.begin(pixel);
  for (int64_t k = 0; k < width; ++k) {
    const int64_t ahead = k * count, back = (width - 1 - k) * count;
    const bool first = 2 * k < width;
    if (first)
      step<kWide, true>(kept.of(k % 2), costs + ahead, count, kept.of((k + 1) % 2), messages + ahead);
    else
      step<kWide, false>(kept.of(k % 2), costs + ahead, count, kept.of((k + 1) % 2), messages + ahead);
    if (first && ahead != back)
      step<kWide, true>(kept.of(2 + k % 2), costs + back, count, kept.of(2 + (k + 1) % 2), messages + back);
    else
      step<kWide, false>(kept.of(2 + k % 2), costs + back, count, kept.of(2 + (k + 1) % 2), messages + back);
  }
}

int64_t row_scratch(const Pair& pair) { return cost_scratch(pair) + Kept::size(4, pair.count); }

void rows(const Pair& pair, uint8_t* costs, uint8_t* messages, int64_t begin, int64_t end, uint8_t* scratch) {
  sum_costs(pair, costs, begin, end, scratch);
  const int64_t row = int64_t(pair.width) * pair.count;
  const Kept kept = {scratch, pair.count};
  with_width<kRegisterBytes>(pair.count, [&](auto wide) {
    for (int64_t y = begin; y < end; ++y)
      along_row<decltype(wide)::value>(costs + y * row, messages + y * row, pair.width, pair.count, kept);
  });
}

int64_t column_scratch(const Pair& pair, int64_t columns) { return 2 * Kept::size(columns, pair.count); }

template <int kWide>
GSPLAT_INLINE void along_columns(const Pair& pair, const uint8_t* costs, uint8_t* messages, int64_t begin, int64_t end, int down,
                                 Kept before, Kept after) {
  for (int64_t i = 0; i < end - begin; ++i) before.begin(i), after.begin(i);
  for (int64_t k = 0; k < pair.height; ++k) {
    const int64_t y = down ? k : pair.height - 1 - k, first = (y * pair.width + begin) * pair.count;
    for (int64_t i = 0; i < end - begin; ++i) {
      const int64_t at = first + i * pair.count;
      step<kWide, false>(before.of(i), costs + at, pair.count, after.of(i), messages + at);
    }
    const Kept both = before;
    before = after, after = both;
  }
}

void columns(const Pair& pair, const uint8_t* costs, uint8_t* messages, int64_t begin, int64_t end, uint8_t* scratch) {
  const Kept one = {scratch, pair.count}, other = {scratch + Kept::size(end - begin, pair.count), pair.count};
  with_width<kRegisterBytes>(pair.count, [&](auto wide) {
    for (int down = 1; down >= 0; --down)
      along_columns<decltype(wide)::value>(pair, costs, messages, begin, end, down, one, other);
  });
}

}  // namespace

extern const Kernels kernels = {row_scratch, column_scratch, rows, columns, winners, drop_patches, surfaces};

}  // namespace GSPLAT_ISA::stereo_matching
