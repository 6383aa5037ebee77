// From costs and messages to disparities: the best ones, checked, without small patches.
#include "byte_rows.h"

namespace GSPLAT_ISA::stereo_matching {
namespace {

constexpr uint32_t kNone = ~0u;

// The total of a disparity with its number: of equal totals the lowest disparity's is the least.
GSPLAT_INLINE uint32_t key_of(uint32_t total, int disparity) { return total << 8 | uint32_t(disparity); }

struct Best {
  int disparity;
  uint32_t key;
  int32_t sixteenths;  // kUnknown where another one, that is not beside it, is nearly as good
};

template <int kWide>
GSPLAT_INLINE Best best_of(const uint8_t* costs, const uint8_t* messages, int count) {
  uint32_t keys[kMostDisparities], least[kWide];
  for (int i = 0; i < kWide; ++i) least[i] = kNone;
  for (int first = 0; first < count; first += kWide) {
    for (int i = first; i < first + kWide; ++i) {
      keys[i] = key_of(kPaths * uint32_t(costs[i]) + messages[i], i);
      least[i - first] = less(least[i - first], keys[i]);
    }
  }
  uint32_t key = least[0];
  for (int i = 1; i < kWide; ++i) key = less(key, least[i]);
  const uint32_t total = key >> 8;
  const int best = int(key & 255);
  const auto total_of = [&](int i) { return int(keys[i] >> 8); };
  // Nearly as good: total * (100 - percent) < best * 100.
  const uint32_t nearly = (total * 100 + 99 - kUniquenessPercent) / (100 - kUniquenessPercent) << 8;
  int rivals = 0;
  for (int first = 0; first < count; first += kWide)
    for (int i = first; i < first + kWide; ++i) rivals += keys[i] < nearly;
  for (int i = more(best - 1, 0); i <= less(best + 1, count - 1); ++i) rivals -= keys[i] < nearly;
  int sixteenths = 0;
  if (best > 0 && best < count - 1) {  // the lowest point of a parabola
    const int bend = more(total_of(best - 1) + total_of(best + 1) - 2 * int(total), 1);
    const int twice = (total_of(best - 1) - total_of(best + 1)) * kSixteenths + bend;
    sixteenths = twice / (2 * bend);
  }
  return {best, key, rivals > 0 ? kUnknown : kSixteenths * best + sixteenths};
}

GSPLAT_INLINE int floor_of(int sixteenths) { return sixteenths >> 4; }

// Whether the right eye's pixel that belongs to a disparity prefers another one.
GSPLAT_INLINE bool differs(const Pair& pair, const uint32_t* right, int64_t x, int disparity) {
  const int64_t there = x - disparity;
  if (there < 0 || there >= pair.width || right[there] == kNone) return false;
  const int other = pair.lowest + int(right[there] & 255);
  return other > disparity + kLeftRightMost || other < disparity - kLeftRightMost;
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
  const int64_t width = pair.width;
  for (int64_t y = begin; y < end; ++y) {
    int32_t* const row = sixteenths + y * width;
    for (int64_t x = 0; x < width; ++x) right[x] = kNone;
    for (int64_t x = 0; x < width; ++x) {
      const int64_t at = (y * width + x) * pair.count;
      const Best best = best_of<16>(costs + at, messages + at, pair.count);
      const bool known = best.sixteenths != kUnknown;
      row[x] = known ? kSixteenths * pair.lowest + best.sixteenths : kUnknown;
      const int64_t there = x - pair.lowest - best.disparity;
      if (known && there >= 0 && there < width) right[there] = less(right[there], best.key);
    }
    for (int64_t x = 0; x < width; ++x) {
      if (row[x] == kUnknown) continue;
      const int64_t there = kSixteenths * x - row[x];
      const bool outside = there < 0 || there > kSixteenths * (width - 1);
      const int below = floor_of(row[x]), above = floor_of(row[x] + kSixteenths - 1);
      if (outside || (differs(pair, right, x, below) && differs(pair, right, x, above))) row[x] = kUnknown;
    }
  }
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

void surfaces(const Pair& pair, const Matched& matched, int64_t begin, int64_t end, int32_t* scratch) {
  const int64_t width = pair.width, height = pair.height;
  int32_t *const least = scratch, *const most = scratch + width, *const holes = scratch + 2 * width;
  for (int64_t y = begin; y < end; ++y) {
    for (int64_t x = 0; x < width; ++x) least[x] = INT32_MAX, most[x] = kUnknown, holes[x] = 0;
    for (int64_t from = more(y - kJumpRadius, int64_t(0)); from <= less(y + kJumpRadius, height - 1); ++from) {
      const int32_t* const row = matched.sixteenths + from * width;
      const bool near = from >= y - kHoleRadius && from <= y + kHoleRadius;
      for (int64_t x = 0; x < width; ++x) {
        least[x] = less(least[x], row[x] == kUnknown ? INT32_MAX : row[x]);
        most[x] = more(most[x], row[x]);
        holes[x] |= near && row[x] == kUnknown;
      }
    }
    for (int64_t x = 0; x < width; ++x) {
      int32_t low = INT32_MAX, high = kUnknown, hole = 0;
      for (int64_t from = more(x - kJumpRadius, int64_t(0)); from <= less(x + kJumpRadius, width - 1); ++from) {
        low = less(low, least[from]), high = more(high, most[from]);
        hole |= from >= x - kHoleRadius && from <= x + kHoleRadius ? holes[from] : 0;
      }
      matched.one_surface[y * width + x] = hole == 0 && high - low <= kJumpMost;
    }
  }
}

}  // namespace GSPLAT_ISA::stereo_matching
