// Semi-global matching (Hirschmüller 2008) along four paths, and the best label of each pixel.
#include "plane_vectors.h"

namespace GSPLAT_ISA::plane_sweep {
namespace {

constexpr int kWide = kRegisterBytes / 2;  // labels per vector
using Words = Vector<kWide>::Words;

// Costs of labels out of range, by which a pixel's labels are filled up to a multiple of kWide, and before and after them.
// No path to another label passes through them, and the sum of four paths fits into 16 bits.
constexpr int kFiller = 14000, kNever = 30000, kMargin = 1;
static_assert(4 * (kFiller + kLargeStep) < 1 << 16 && kFiller - kDisagrees > kLargeStep);

GSPLAT_INLINE int64_t padded(int64_t labels) { return (labels + kWide - 1) / kWide * kWide; }

// State of a path at a pixel: the costs of its labels so far, up to a constant, and the least of them.
struct Path {
  uint16_t* costs;
  uint16_t* least;
};

// Paths of several pixels, with a margin before and after the labels.
struct Paths {
  uint16_t* words;
  int64_t size;  // padded labels
  static GSPLAT_METHOD int64_t words_of(int64_t pixels, int64_t size) { return pixels * (size + 2 * kMargin + 1); }
  GSPLAT_METHOD Path at(int64_t pixel) const {
    uint16_t* const from = words + words_of(pixel, size);
    return {from + kMargin, from + size + 2 * kMargin};
  }
  // Start a path: all labels are equal.
  GSPLAT_METHOD void begin(int64_t pixel) const {
    const Path path = at(pixel);
    for (int64_t i = -kMargin; i < size + kMargin; ++i) path.costs[i] = i < 0 || i >= size ? kNever : 0;
    *path.least = 0;
  }
};

// Advance a path by one pixel, and store (kFirst) or add its costs to `totals`. before and after may be the same.
template <bool kFirst>
GSPLAT_INLINE void step(const Path& before, const uint16_t* costs, int64_t size, const Path& after, uint16_t* totals) {
  const Words start = Words{} + *before.least, jump = start + uint16_t(kLargeStep);
  Words least = Words{} + uint16_t(65535), below = load_as<Words>(before.costs - 1);
  for (int64_t d = 0; d < size; d += kWide) {
    const Words here = load_as<Words>(before.costs + d), above = load_as<Words>(before.costs + d + 1);
    const Words best = less(less(here, less(below, above) + uint16_t(kSmallStep)), jump);
    const Words path = load_as<Words>(costs + d) + (best - start);
    below = load_as<Words>(before.costs + d + kWide - 1);
    store_as(after.costs + d, path);
    store_as(totals + d, kFirst ? path : load_as<Words>(totals + d) + path);
    least = less(least, path);
  }
  *after.least = least_word(least);
}

// Copy a row's costs with fillers to `to` [width, size], and return the largest of them.
GSPLAT_INLINE int32_t fill(const int16_t* costs, int64_t width, int64_t labels, int64_t size, uint16_t* to) {
  Words most = {};
  for (int64_t x = 0; x < width; ++x) {
    const uint16_t* const from = reinterpret_cast<const uint16_t*>(costs) + x * labels;
    int64_t d = 0;
    for (; d + kWide <= labels; d += kWide) {
      const Words values = load_as<Words>(from + d);
      most = more(most, values);
      store_as(to + x * size + d, values);
    }
    if (d == labels) continue;
    Words last = Words{} + uint16_t(kFiller);
    for (int i = 0; i < kWide; ++i)
      if (d + i < labels) {
        last[i] = from[d + i];
        most[i] = more(most[i], from[d + i]);
      }
    store_as(to + x * size + d, last);
  }
  return 65535 - least_word(~most);
}

struct Best {
  float label, unique;
};

// Find the best label by the totals of the paths.
GSPLAT_INLINE Best best_of(const uint16_t* totals, int labels, int64_t size) {
  const Words none = Words{} + uint16_t(65535);
  Words lanes, low = none, first = none, rival = none;
  for (int i = 0; i < kWide; ++i) lanes[i] = uint16_t(i);
  for (int64_t d = 0; d < size; d += kWide) low = less(low, load_as<Words>(totals + d));
  const uint16_t least = least_word(low);
  for (int64_t d = 0; d < size; d += kWide) first = less(first, load_as<Words>(totals + d) == least ? lanes + uint16_t(d) : none);
  const int best = least_word(first);
  for (int64_t d = 0; d < size; d += kWide) {
    const Words beside = lanes + uint16_t(d - best + kNear);  // 0 to 2 kNear for the labels near the best one
    rival = less(rival, beside > uint16_t(2 * kNear) ? load_as<Words>(totals + d) : none);
  }
  const uint16_t second = least_word(rival);
  float shift = 0;
  if (best > 0 && best < labels - 1) {  // vertex of a parabola
    const int below = totals[best - 1], above = totals[best + 1], bend = below - 2 * int(least) + above;
    if (bend > 0) shift = 0.5f * float(below - above) / float(bend);
  }
  const bool alone = best <= kNear && best + kNear >= labels - 1;
  const float smallest = 1e-6f * kCostSteps;
  return {float(best) + shift, alone ? __builtin_inff() : float(second - least) / more(float(least), smallest)};
}

}  // namespace

int64_t label_scratch(const Volume& in) {
  const int64_t size = padded(in.labels), pixels = int64_t(in.width) * in.height;
  return int64_t(sizeof(uint16_t)) * (pixels * size + in.width * size + size + Paths::words_of(in.width + 1, size) + kWide);
}

int32_t labels(const Volume& in, uint8_t* scratch, const Selected& out) {
  const int64_t size = padded(in.labels), width = in.width;
  uint16_t* const totals = reinterpret_cast<uint16_t*>(scratch);  // [height, width, size]
  uint16_t* const costs = totals + in.height * width * size;      // [width, size]
  uint16_t* const sums = costs + width * size;                    // [size]
  const Paths column = {sums + size, size}, row = {column.words + Paths::words_of(width, size), size};
  const Path along = row.at(0);
  int32_t most = 0;
  for (int64_t x = 0; x < width; ++x) column.begin(x);
  for (int64_t y = 0; y < in.height; ++y) {
    most = more(most, fill(in.costs + y * width * in.labels, width, in.labels, size, costs));
    uint16_t* const to = totals + y * width * size;
    row.begin(0);
    for (int64_t x = 0; x < width; ++x) step<true>(along, costs + x * size, size, along, to + x * size);
    row.begin(0);
    for (int64_t x = width - 1; x >= 0; --x) step<false>(along, costs + x * size, size, along, to + x * size);
    for (int64_t x = 0; x < width; ++x) step<false>(column.at(x), costs + x * size, size, column.at(x), to + x * size);
  }
  if (most > kDisagrees) return most;
  for (int64_t x = 0; x < width; ++x) column.begin(x);
  for (int64_t y = in.height - 1; y >= 0; --y) {
    fill(in.costs + y * width * in.labels, width, in.labels, size, costs);
    for (int64_t x = 0; x < width; ++x) {
      const int64_t pixel = y * width + x;
      uint16_t* const total = totals + pixel * size;
      step<false>(column.at(x), costs + x * size, size, column.at(x), total);
      const Best best = best_of(total, in.labels, size);
      const int64_t nearest = pixel * in.labels + int64_t(__builtin_rintf(best.label));
      out.labels[pixel] = best.label;
      out.unique[pixel] = best.unique;
      out.cost[pixel] = float(in.costs[nearest]) * (1.0f / kCostSteps);
      out.agreeing[pixel] = in.votes[nearest];
    }
  }
  return most;
}

}  // namespace GSPLAT_ISA::plane_sweep
