// Matching costs of every disparity at every pixel: warps sum pixel differences along the rows, then threads sum them
// down the columns.
#include "cuda_check.h"
#include "cuda_scratch.h"
#include "volume.cuh"

namespace gsplat::stereo_matching {
namespace {

// Lengths of the segments of a row or column that one warp or thread sums; longer segments recompute less overlap.
constexpr int kSegmentColumns = 64, kSegmentRows = 32;

// Features of a pixel that are compared between the images: slope and brightness, and their range within half a pixel
// to both sides.
struct __align__(8) Features {
  uint8_t slope, slope_low, slope_high, brightness, brightness_low, brightness_high, unused[2];
};

__device__ inline int within(int i, int size) { return min(max(i, 0), size - 1); }

struct Picture {
  const uint8_t* pixels;
  int height, width;
  __device__ int at(int y, int x) const { return pixels[int64_t(within(y, height)) * width + within(x, width)]; }
  __device__ int slope(int y, int x) const {
    const int l = within(x, width) - 1, r = l + 2;
    const int sum = 2 * (at(y, r) - at(y, l)) + at(y - 1, r) - at(y - 1, l) + at(y + 1, r) - at(y + 1, l);
    return min(max(sum, -kSlopeCap), kSlopeCap) + kSlopeCap;
  }
};

struct Range {
  uint8_t low, high;
};
__device__ inline Range range_of(int before, int here, int after) {
  const int one = (here + before) / 2, other = (here + after) / 2;
  return {uint8_t(min(here, min(one, other))), uint8_t(max(here, max(one, other)))};
}

// Compute slope, brightness and their ranges at both images' pixels. features: [2, height, width], left image first.
__global__ void __launch_bounds__(kThreads) compute_features(Pair pair, Features* features) {
  const int64_t pixels = int64_t(pair.height) * pair.width, i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= 2 * pixels) return;
  const Picture picture = {i < pixels ? pair.left : pair.right, pair.height, pair.width};
  const int y = int(i % pixels / pair.width), x = int(i % pair.width);
  const int slope = picture.slope(y, x), brightness = picture.at(y, x);
  const Range s = range_of(picture.slope(y, x - 1), slope, picture.slope(y, x + 1));
  const Range b = range_of(picture.at(y, x - 1), brightness, picture.at(y, x + 1));
  features[i] = {uint8_t(slope), s.low, s.high, uint8_t(brightness), b.low, b.high, {}};
}

// Return the Birchfield-Tomasi difference of two pixels: the smaller of the distances of each value from the other's
// range.
__device__ inline int difference(int a, int a_low, int a_high, int b, int b_low, int b_high) {
  return max(0, min(max(a - b_high, b_low - a), max(b - a_high, a_low - b)));
}
__device__ inline int pixel_cost(const Features& a, const Features& b) {
  const int by_slope = difference(a.slope, a.slope_low, a.slope_high, b.slope, b.slope_low, b.slope_high);
  const int by_brightness =
      difference(a.brightness, a.brightness_low, a.brightness_high, b.brightness, b.brightness_low, b.brightness_high);
  return by_slope + min(by_brightness, kBrightnessMost);
}

// Sum the differences over the window's columns [height, width, count], with one warp per segment of a row.
template <int kEach>
__global__ void __launch_bounds__(kThreads) sum_along_rows(Pair pair, const Features* features, uint16_t* sums) {
  const int lane = threadIdx.x % 32, segments = (pair.width + kSegmentColumns - 1) / kSegmentColumns;
  const int64_t warp = int64_t(blockIdx.x) * (kThreads / 32) + threadIdx.x / 32;
  if (warp >= int64_t(segments) * pair.height || lane * kEach >= pair.count) return;
  const int y = int(warp / segments), begin = int(warp % segments) * kSegmentColumns;
  const Features* const left = features + int64_t(y) * pair.width;
  const Features* const right = left + int64_t(pair.height) * pair.width;
  int sum[kEach] = {};
  const auto add = [&](int x, int sign) {
    x = within(x, pair.width);
    const Features here = left[x];
#pragma unroll
    for (int k = 0; k < kEach; ++k)
      sum[k] += sign * pixel_cost(here, right[within(x - pair.lowest - lane * kEach - k, pair.width)]);
  };
  for (int x = begin - kWindowRadius; x < begin + kWindowRadius; ++x) add(x, 1);
  for (int x = begin; x < min(begin + kSegmentColumns, pair.width); ++x) {
    add(x + kWindowRadius, 1);
    uint16_t* const to = sums + (int64_t(y) * pair.width + x) * pair.count + lane * kEach;
#pragma unroll
    for (int k = 0; k < kEach; ++k) to[k] = uint16_t(sum[k]);
    add(x - kWindowRadius, -1);
  }
}

// Sum over the whole window and convert to costs, with one thread per eight disparities of a column segment. Two 16-bit
// sums share a word; neither becomes negative or overflows.
__global__ void __launch_bounds__(kThreads) sum_down_columns(Pair pair, const uint4* sums, uint2* costs) {
  const int64_t row = int64_t(pair.width) * pair.count / 8, at = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (at >= row) return;
  const int begin = blockIdx.y * kSegmentRows, end = min(begin + kSegmentRows, pair.height);
  uint4 sum = {};
  const auto add = [&](int y) {
    const uint4 enters = sums[within(y, pair.height) * row + at];
    sum.x += enters.x, sum.y += enters.y, sum.z += enters.z, sum.w += enters.w;
  };
  const auto cost = [](uint32_t sum) { return min(sum >> kCostShift, uint32_t(kMostCost)); };
  const auto two = [&](uint32_t word) { return cost(word & 0xffff) | cost(word >> 16) << 8; };
  for (int y = begin - kWindowRadius; y < begin + kWindowRadius; ++y) add(y);
  for (int y = begin; y < end; ++y) {
    add(y + kWindowRadius);
    costs[y * row + at] = {two(sum.x) | two(sum.y) << 16, two(sum.z) | two(sum.w) << 16};
    const uint4 leaves = sums[within(y - kWindowRadius, pair.height) * row + at];
    sum.x -= leaves.x, sum.y -= leaves.y, sum.z -= leaves.z, sum.w -= leaves.w;
  }
}

}  // namespace

void sum_costs(const Pair& pair, uint8_t* costs, uint16_t* sums, CudaScratch& scratch, cudaStream_t stream) {
  const int64_t pixels = int64_t(pair.height) * pair.width;
  Features* const features = scratch.array<Features>(2 * pixels);
  compute_features<<<blocks_for(2 * pixels), kThreads, 0, stream>>>(pair, features);
  const int64_t segments = (pair.width + kSegmentColumns - 1) / kSegmentColumns * int64_t(pair.height);
  with_each(pair.count, [&](auto each) {
    sum_along_rows<each.value><<<blocks_for(segments, kThreads / 32), kThreads, 0, stream>>>(pair, features, sums);
  });
  const dim3 blocks(blocks_for(int64_t(pair.width) * pair.count / 8), blocks_for(pair.height, kSegmentRows));
  sum_down_columns<<<blocks, kThreads, 0, stream>>>(pair, reinterpret_cast<const uint4*>(sums), reinterpret_cast<uint2*>(costs));
}

}  // namespace gsplat::stereo_matching
