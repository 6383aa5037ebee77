// Solves a vector of lines at a time by forward elimination and back substitution.
#include "edge_aware_filter.h"
#include "simd_partial.h"

namespace GSPLAT_ISA::edge_aware_filter {

using namespace gsplat::edge_aware_filter;

namespace {

GSPLAT_INLINE float squared_change(const Guide& guide, int64_t one, int64_t other) {
  float squares = 0;
  for (int c = 0; c < guide.channels; ++c) {
    const float change = float(guide.pixels[one * guide.channels + c]) - float(guide.pixels[other * guide.channels + c]);
    squares += change * change;
  }
  return squares;
}

// Convert squared changes of the guide between neighbouring pixels to links (weights of the smoothing), in place.
GSPLAT_INLINE void weaken(float* links, int64_t count, float per_step) {
  const float scale = -1.44269504f * per_step;
  for (int64_t x = 0; x < count; x += kLanes) {
    const vfloat change = sqrt(load_first(links + x, count - x));
    store_first(links + x, exp2(max(scale * change, splat(-100.0f))), count - x);
  }
}

void link(const Guide& guide, float* right, float* down, int64_t begin, int64_t end) {
  const int64_t width = guide.width;
  for (int64_t y = begin; y < end; ++y) {
    const int64_t row = y * width;
    for (int64_t x = 0; x < width; ++x) {
      const int64_t at = row + x;
      right[at] = squared_change(guide, at, x + 1 < width ? at + 1 : at);
      down[at] = squared_change(guide, at, y + 1 < guide.height ? at + width : at);
    }
    weaken(right + row, width, guide.per_step);
    weaken(down + row, width, guide.per_step);
  }
}

// Load the pixels of neighbouring lines, one line per vector lane; the last group may have fewer lines than lanes.
GSPLAT_INLINE vfloat take(const float* from, int64_t across, int lanes) {
  if (across == 1 && lanes == kLanes) return load(from);
  vfloat taken = vfloat{};
  for (int i = 0; i < lanes; ++i) taken[i] = from[i * across];
  return taken;
}
GSPLAT_INLINE void give(float* to, int64_t across, int lanes, vfloat values) {
  if (across == 1 && lanes == kLanes) return store(to, values);
  for (int i = 0; i < lanes; ++i) to[i * across] = values[i];
}

void smooth(const Lines& lines, int64_t begin, int64_t end, float* scratch) {
  float *const above = scratch, *const known = scratch + lines.length * kLanes;  // coefficients of the eliminated rows
  for (int64_t first = begin; first < end; first += kLanes) {
    const int lanes = int(end - first < kLanes ? end - first : kLanes);
    const int64_t begin_of = first * lines.across;
    vfloat link_before = vfloat{}, above_before = vfloat{}, known_before = vfloat{};
    for (int64_t i = 0; i < lines.length; ++i) {
      const int64_t at = begin_of + i * lines.along;
      const vfloat next = i + 1 < lines.length ? lines.strength * take(lines.links + at, lines.across, lanes) : vfloat{};
      const vfloat middle = 1.0f + link_before + next - link_before * above_before;
      known_before = (take(lines.plane + at, lines.across, lanes) + link_before * known_before) / middle;
      above_before = next / middle;
      link_before = next;
      store(above + i * kLanes, above_before);
      store(known + i * kLanes, known_before);
    }
    vfloat value = vfloat{};
    for (int64_t i = lines.length - 1; i >= 0; --i) {
      value = load(known + i * kLanes) + load(above + i * kLanes) * value;
      give(lines.plane + begin_of + i * lines.along, lines.across, lanes, value);
    }
  }
}

}  // namespace

extern const Kernels kernels = {link, smooth, kLanes};

}  // namespace GSPLAT_ISA::edge_aware_filter
