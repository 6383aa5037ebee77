// Processes rows of each plane. The window is applied vertically, then horizontally.
#include "disparity_fit.h"
#include "simd_partial.h"

namespace GSPLAT_ISA::disparity_fit {

using namespace gsplat::disparity_fit;

namespace {

GSPLAT_INLINE int64_t within(int64_t i, int64_t size) { return i < 0 ? 0 : i < size ? i : size - 1; }
GSPLAT_INLINE float clamped(float x, float most) { return x < -most ? -most : x > most ? most : x; }

// Write the window sums of a row of `plane` to `sums`. column: scratch with kRadius zeros on both sides of the image
// width.
GSPLAT_INLINE void window_row(const Fit& fit, const float* plane, int64_t y, float* column, float* sums) {
  const int64_t width = fit.width;
  const float* const taps = fit.taps.tap;
  float* const middle = column + kRadius;
  for (int64_t x = 0; x < kRadius; ++x) column[x] = 0, middle[width + x] = 0;
  for (int64_t x = 0; x < width; x += kLanes) {
    const auto row = [&](int64_t from) { return load_first(plane + from * width + x, width - x); };
    vfloat sum = taps[0] * row(y);
    for (int k = 1; k <= kRadius; ++k) {
      if (y - k >= 0) sum = fma(splat(taps[k]), row(y - k), sum);
      if (y + k < fit.height) sum = fma(splat(taps[k]), row(y + k), sum);
    }
    store_first(middle + x, sum, width - x);
  }
  for (int64_t x = 0; x < width; x += kLanes) {
    const auto at = [&](int64_t from) { return load_first(middle + x + from, width - x); };
    vfloat sum = taps[0] * at(0);
    for (int k = 1; k <= kRadius; ++k) sum = fma(splat(taps[k]), at(-k) + at(k), sum);
    store_first(sums + x, sum, width - x);
  }
}

void prepare(const Fit& fit, const Planes& planes, int64_t begin, int64_t end) {
  const int64_t width = fit.width;
  for (int64_t y = begin; y < end; ++y) {
    const uint8_t* const here = fit.right + y * width;
    const uint8_t* const above = fit.right + within(y - 1, fit.height) * width;
    const uint8_t* const below = fit.right + within(y + 1, fit.height) * width;
    for (int64_t x = 0; x < width; ++x) {
      const int64_t l = within(x - 1, width), r = within(x + 1, width), at = y * width + x;
      const int slope =
          10 * (here[r] - here[l]) + 3 * (above[r] - above[l] + below[r] - below[l]);  // Scharr derivative, normalised by 32
      planes.slope[at] = float(slope) * (1.0f / 32.0f);
      const bool known = fit.sixteenths[at] != kUnknown;
      planes.information[at] = known ? 1.0f : 0.0f;  // mask of known pixels, an input of `share`
      fit.px[at] = known ? float(fit.sixteenths[at]) * kPerSixteenth : 0.0f;
    }
  }
}

// `information` is not needed yet, and holds the mask of known pixels.
void share(const Fit& fit, const Planes& planes, int64_t begin, int64_t end, float* column) {
  for (int64_t y = begin; y < end; ++y) {
    float* const shares = planes.known + y * fit.width;
    window_row(fit, planes.information, y, column, shares);
    for (int64_t x = 0; x < fit.width; ++x) shares[x] = shares[x] > kLeastKnown ? shares[x] : kLeastKnown;
  }
}

void sample(const Fit& fit, const Planes& planes, int64_t begin, int64_t end) {
  const int64_t width = fit.width;
  for (int64_t y = begin; y < end; ++y) {
    const uint8_t* const other = fit.right + y * width;
    const float* const slopes = planes.slope + y * width;
    for (int64_t x = 0; x < width; ++x) {
      const int64_t at = y * width + x;
      const float there = float(x) - fit.px[at], most = float(width - 1);
      const float column = there < 0 ? 0.0f : there > most ? most : there;
      const int32_t first = int32_t(column), next = first + 1 < width ? first + 1 : first;
      const float share = column - float(first), known = fit.sixteenths[at] == kUnknown ? 0.0f : 1.0f;
      const float seen = float(other[first]) + share * (float(other[next]) - float(other[first]));
      planes.differs[at] = known * (float(fit.left[at]) - seen);
      planes.rise[at] = known * (slopes[first] + share * (slopes[next] - slopes[first]));
    }
  }
}

void weigh(const Fit& fit, const Planes& planes, int64_t begin, int64_t end, float* scratch) {
  const int64_t width = fit.width;
  float *const mean = scratch, *const column = scratch + width;
  for (int64_t y = begin; y < end; ++y) {
    const int64_t row = y * width;
    window_row(fit, planes.differs, y, column, mean);
    for (int64_t x = 0; x < width; ++x) {
      const int64_t at = row + x;
      const float there = fit.sixteenths[at] == kUnknown ? 0.0f : 1.0f;
      const float differs = planes.differs[at] - mean[x] / planes.known[at], odd = differs * (1.0f / kOutlier);
      const float weight = there / (1.0f + odd * odd), rise = planes.rise[at];
      planes.information[at] = weight * rise * rise;
      planes.pull[at] = weight * rise * differs;
      planes.difference[at] = weight * differs * differs;
    }
  }
}

GSPLAT_INLINE void write_error(const Fit& fit, const Planes& planes, int64_t y, const float* information, float* column) {
  const int64_t row = y * fit.width;
  float* const error = fit.error_px + row;
  window_row(fit, planes.difference, y, column, error);
  for (int64_t x = 0; x < fit.width; ++x) {
    const float least = kIndependentPixels * information[x];
    const float variance = (error[x] + planes.known[row + x]) / (least > 1e-6f ? least : 1e-6f);
    const bool known = fit.sixteenths[row + x] != kUnknown;
    error[x] = known ? __builtin_sqrtf(variance) : __builtin_inff();
    if (!known) fit.px[row + x] = 0;
  }
}

void move(const Fit& fit, const Planes& planes, bool last, int64_t begin, int64_t end, float* scratch) {
  const int64_t width = fit.width;
  float *const information = scratch, *const pull = scratch + width, *const column = scratch + 2 * width;
  for (int64_t y = begin; y < end; ++y) {
    const int64_t row = y * width;
    window_row(fit, planes.information, y, column, information);
    window_row(fit, planes.pull, y, column, pull);
    for (int64_t x = 0; x < width; ++x) {
      const int64_t at = row + x;
      const bool known = fit.sixteenths[at] != kUnknown;
      const float start = float(known ? fit.sixteenths[at] : 0) * kPerSixteenth;
      const float moved = fit.px[at] - clamped(pull[x] / (information[x] + kResistance), kMostStep);
      fit.px[at] = start + clamped(moved - start, kMostFromStart);
    }
    if (last) write_error(fit, planes, y, information, column);
  }
}

}  // namespace

extern const Kernels kernels = {prepare, share, sample, weigh, move};

}  // namespace GSPLAT_ISA::disparity_fit
