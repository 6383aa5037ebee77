// From costs and messages to disparities: the best ones, checked for consistency, without small patches.
#include "disparity_vectors.h"

namespace GSPLAT_ISA::stereo_matching {
namespace {

constexpr uint32_t kNone = ~0u;

// Total cost combined with the disparity number, so that ties resolve to the lowest disparity.
GSPLAT_INLINE uint32_t key_of(int total, int disparity) { return uint32_t(total) << 8 | uint32_t(disparity); }

struct Best {
  int disparity, total;
  int32_t sixteenths;  // kUnknown if a disparity other than a neighbour is nearly as good
};

template <int kWide>
GSPLAT_INLINE Best best_of(const uint8_t* costs, const uint8_t* messages, int count) {
  using Bytes = typename Vector<kWide>::Bytes;
  using Words = typename Vector<kWide>::Words;
  uint16_t totals[kMostDisparities];
  const Words none = Words{} + uint16_t(65535);
  Words lanes, low = none, first_of = none, rival = none;
  for (int i = 0; i < kWide; ++i) lanes[i] = uint16_t(i);
  for (int d = 0; d < count; d += kWide) {
    const Words cost = __builtin_convertvector(load_as<Bytes>(costs + d), Words);
    const Words total = cost * uint16_t(kPaths) + __builtin_convertvector(load_as<Bytes>(messages + d), Words);
    store_as(totals + d, total);
    low = less(low, total);
  }
  const uint16_t least = least_word(low);
  for (int d = 0; d < count; d += kWide)
    first_of = less(first_of, load_as<Words>(totals + d) == least ? lanes + uint16_t(d) : none);
  const int best = least_word(first_of);
  for (int d = 0; d < count; d += kWide) {
    const Words beside = lanes + uint16_t(d - best + 1);  // 0, 1, 2 for the best disparity and its neighbours
    rival = less(rival, beside > uint16_t(2) ? load_as<Words>(totals + d) : none);
  }
  int sixteenths = 0;
  if (best > 0 && best < count - 1) {  // vertex of a parabola
    const int below = totals[best - 1], above = totals[best + 1], bend = more(below + above - 2 * least, 1);
    sixteenths = ((below - above) * kSixteenths + bend) / (2 * bend);
  }
  const bool unique = int(least_word(rival)) * (100 - kUniquenessPercent) >= least * 100;
  return {best, least, unique ? kSixteenths * best + sixteenths : kUnknown};
}

GSPLAT_INLINE int floor_of(int sixteenths) { return sixteenths >> 4; }

// Return true if the matching pixel of the right image prefers another disparity.
GSPLAT_INLINE bool differs(const Pair& pair, const uint32_t* right, int64_t x, int disparity) {
  const int64_t there = x - disparity;
  if (there < 0 || there >= pair.width || right[there] == kNone) return false;
  const int other = pair.lowest + int(right[there] & 255);
  return other > disparity + kLeftRightMost || other < disparity - kLeftRightMost;
}

// Find the best disparities of a row. For the matching pixels of the right image, also store the minimum key of all
// pixels matched with them.
template <int kWide>
GSPLAT_INLINE void find_row(const Pair& pair, const uint8_t* costs, const uint8_t* messages, int64_t y, int32_t* sixteenths,
                            uint32_t* right) {
  const int64_t width = pair.width;
  for (int64_t x = 0; x < width; ++x) right[x] = kNone;
  for (int64_t x = 0; x < width; ++x) {
    const int64_t pixel = y * width + x, at = pixel * pair.count;
    const Best best = best_of<kWide>(costs + at, messages + at, pair.count);
    const bool known = best.sixteenths != kUnknown;
    sixteenths[pixel] = known ? kSixteenths * pair.lowest + best.sixteenths : kUnknown;
    const int64_t there = x - pair.lowest - best.disparity;
    if (known && there >= 0 && there < width) right[there] = less(right[there], key_of(best.total, best.disparity));
  }
}

GSPLAT_INLINE void check_row(const Pair& pair, const uint32_t* right, int32_t* row) {
  for (int64_t x = 0; x < pair.width; ++x) {
    if (row[x] == kUnknown) continue;
    const int64_t there = kSixteenths * x - row[x];
    const bool outside = there < 0 || there > kSixteenths * (int64_t(pair.width) - 1);
    const int below = floor_of(row[x]), above = floor_of(row[x] + kSixteenths - 1);
    if (outside || (differs(pair, right, x, below) && differs(pair, right, x, above))) row[x] = kUnknown;
  }
}

GSPLAT_INLINE int root_of(int32_t* parents, int i) {
  while (parents[i] != i) i = parents[i] = parents[parents[i]];
  return i;
}

GSPLAT_INLINE void link(const int32_t* sixteenths, int32_t* parents, int a, int b) {
  const int64_t change = int64_t(sixteenths[a]) - sixteenths[b];
  if (sixteenths[b] == kUnknown || change > kPatchStep || change < -kPatchStep) return;
  const int one = root_of(parents, a), other = root_of(parents, b);
  parents[more(one, other)] = less(one, other);
}

}  // namespace

void winners(const Pair& pair, const uint8_t* costs, const uint8_t* messages, int32_t* sixteenths, int64_t begin, int64_t end,
             uint32_t* right) {
  with_width<kRegisterBytes / 2>(pair.count, [&](auto wide) {
    for (int64_t y = begin; y < end; ++y) {
      find_row<decltype(wide)::value>(pair, costs, messages, y, sixteenths, right);
      check_row(pair, right, sixteenths + y * pair.width);
    }
  });
}

void drop_patches(const Pair& pair, int32_t* sixteenths, int32_t* scratch) {
  const int width = pair.width, pixels = pair.width * pair.height;
  int32_t *const parents = scratch, *const sizes = scratch + pixels;
  for (int i = 0; i < pixels; ++i) {
    parents[i] = i, sizes[i] = 0;
    if (sixteenths[i] == kUnknown) continue;
    if (i % width > 0) link(sixteenths, parents, i, i - 1);
    if (i >= width) link(sixteenths, parents, i, i - width);
  }
  for (int i = 0; i < pixels; ++i) ++sizes[root_of(parents, i)];
  for (int i = 0; i < pixels; ++i)
    if (sizes[root_of(parents, i)] <= kPatchPixels) sixteenths[i] = kUnknown;
}

// Write to `one_surface` of rows [begin, end) whether the disparities within kJumpRadius pixels have no jump, and those
// within kHoleRadius no hole. `scratch`: per column, least and greatest disparity of the rows around, and a hole's flag.
void surfaces(const Pair& pair, const Matched& matched, int64_t begin, int64_t end, int32_t* scratch) {
  const int64_t width = pair.width, wide = width + 2 * kJumpRadius;
  int32_t *const least = scratch, *const most = scratch + wide, *const holes = scratch + 2 * wide;
  for (int64_t y = begin; y < end; ++y) {
    for (int64_t x = 0; x < wide; ++x) least[x] = INT32_MAX, most[x] = kUnknown, holes[x] = 0;
    for (int64_t from = more(y - kJumpRadius, int64_t(0)); from <= less(y + kJumpRadius, int64_t(pair.height) - 1); ++from) {
      const int32_t* const row = matched.sixteenths + from * width;
      const int32_t near = from >= y - kHoleRadius && from <= y + kHoleRadius;
      for (int64_t x = 0; x < width; ++x) {
        const int64_t at = x + kJumpRadius;
        const bool hole = row[x] == kUnknown;
        least[at] = less(least[at], hole ? INT32_MAX : row[x]);
        most[at] = more(most[at], row[x]);
        holes[at] |= hole ? near : 0;
      }
    }
    uint8_t* const to = matched.one_surface + y * width;
    for (int64_t x = 0; x < width; ++x) {
      int32_t low = INT32_MAX, high = kUnknown, hole = 0;
      for (int k = 0; k <= 2 * kJumpRadius; ++k) low = less(low, least[x + k]), high = more(high, most[x + k]);
      for (int k = -kHoleRadius; k <= kHoleRadius; ++k) hole |= holes[x + kJumpRadius + k];
      // Unsigned comparison: with unknown neighbours the difference is arbitrary, but then `hole` is set.
      to[x] = uint8_t((hole == 0) & (uint32_t(high) - uint32_t(low) <= uint32_t(kJumpMost)));
    }
  }
}

}  // namespace GSPLAT_ISA::stereo_matching
