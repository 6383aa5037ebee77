// Each step runs two kernels over tiles. A block computes the window sums that it needs in shared memory.
#include "cuda_check.h"
#include "cuda_scratch.h"
#include "disparity_fit.h"

namespace gsplat::disparity_fit {
namespace {

constexpr int kTile = 32, kHalo = kTile + 2 * kRadius;
constexpr int kTileRows = kThreads / kTile;  // rows that a block processes at once

struct Tile {
  int left, top;
  __device__ Tile() : left(int(blockIdx.x) * kTile), top(int(blockIdx.y) * kTile) {}
};

struct Shared {
  float values[kHalo][kHalo + 1], columns[kTile][kHalo + 1];
};

// Window sums of value(y, x) at this thread's pixels, one in every kTileRows rows. value is called only inside of the
// image.
template <class Value>
__device__ inline void window(const Fit& fit, const Tile& tile, Shared& shared, float (&sums)[kTile / kTileRows],
                              const Value& value) {
  __syncthreads();
  for (int i = threadIdx.x; i < kHalo * kHalo; i += kThreads) {
    const int row = i / kHalo, column = i % kHalo, y = tile.top + row - kRadius, x = tile.left + column - kRadius;
    shared.values[row][column] = y >= 0 && y < fit.height && x >= 0 && x < fit.width ? value(y, x) : 0.0f;
  }
  __syncthreads();
  for (int i = threadIdx.x; i < kTile * kHalo; i += kThreads) {
    const int row = i / kHalo + kRadius, column = i % kHalo;
    float sum = fit.taps.tap[0] * shared.values[row][column];
#pragma unroll
    for (int k = 1; k <= kRadius; ++k)
      sum = fmaf(fit.taps.tap[k], shared.values[row - k][column] + shared.values[row + k][column], sum);
    shared.columns[row - kRadius][column] = sum;
  }
  __syncthreads();
#pragma unroll
  for (int i = 0; i < kTile / kTileRows; ++i) {
    const float* const at = &shared.columns[i * kTileRows + threadIdx.x / kTile][threadIdx.x % kTile + kRadius];
    float sum = fit.taps.tap[0] * at[0];
#pragma unroll
    for (int k = 1; k <= kRadius; ++k) sum = fmaf(fit.taps.tap[k], at[-k] + at[k], sum);
    sums[i] = sum;
  }
}

// Call work(i, pixel) for the tile's pixels that this thread processes.
template <class Work>
__device__ inline void for_own(const Fit& fit, const Tile& tile, const Work& work) {
#pragma unroll
  for (int i = 0; i < kTile / kTileRows; ++i) {
    const int y = tile.top + i * kTileRows + int(threadIdx.x) / kTile, x = tile.left + int(threadIdx.x) % kTile;
    if (y < fit.height && x < fit.width) work(i, int64_t(y) * fit.width + x);
  }
}

__device__ inline int within(int i, int size) { return min(max(i, 0), size - 1); }

__global__ void __launch_bounds__(kThreads) prepare(Fit fit, Planes planes) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= int64_t(fit.height) * fit.width) return;
  const int y = int(i / fit.width), x = int(i % fit.width), l = within(x - 1, fit.width), r = within(x + 1, fit.width);
  const auto rise = [&](int row) {
    const uint8_t* const from = fit.right + int64_t(within(row, fit.height)) * fit.width;
    return int(from[r]) - int(from[l]);
  };
  planes.slope[i] =
      float(10 * rise(y) + 3 * (rise(y - 1) + rise(y + 1))) * (1.0f / 32.0f);  // Scharr derivative, normalised by 32
  fit.px[i] = fit.sixteenths[i] == kUnknown ? 0.0f : float(fit.sixteenths[i]) * kPerSixteenth;
}

struct Sample {
  float differs, rise;
};

// Return the intensity difference (left minus right) and the right image's slope at the current disparity; 0 where
// unknown.
__device__ inline Sample sample(const Fit& fit, const Planes& planes, int64_t i, int x) {
  if (fit.sixteenths[i] == kUnknown) return {0, 0};
  const int64_t row = i - x;
  const float column = fminf(fmaxf(float(x) - fit.px[i], 0.0f), float(fit.width - 1));
  const int first = int(column), next = min(first + 1, fit.width - 1);
  const float share = column - float(first), a = float(fit.right[row + first]), b = float(fit.right[row + next]);
  const float rise = planes.slope[row + first], later = planes.slope[row + next];
  return {float(fit.left[i]) - (a + share * (b - a)), rise + share * (later - rise)};
}

__global__ void __launch_bounds__(kThreads) weigh(Fit fit, Planes planes, bool first) {
  __shared__ Shared shared;
  const Tile tile;
  float known[kTile / kTileRows], mean[kTile / kTileRows];
  if (first) {
    window(fit, tile, shared, known,
           [&](int y, int x) { return fit.sixteenths[int64_t(y) * fit.width + x] == kUnknown ? 0.0f : 1.0f; });
  }
  window(fit, tile, shared, mean, [&](int y, int x) { return sample(fit, planes, int64_t(y) * fit.width + x, x).differs; });
  for_own(fit, tile, [&](int i, int64_t pixel) {
    const Sample own = sample(fit, planes, pixel, int(pixel % fit.width));
    const float share = first ? fmaxf(known[i], kLeastKnown) : planes.known[pixel];
    const float differs = own.differs - mean[i] / share, odd = differs * (1.0f / kOutlier);
    const float weight = (fit.sixteenths[pixel] == kUnknown ? 0.0f : 1.0f) / (1.0f + odd * odd);
    if (first) planes.known[pixel] = share;
    planes.information[pixel] = weight * own.rise * own.rise;
    planes.pull[pixel] = weight * own.rise * differs;
    planes.difference[pixel] = weight * differs * differs;
  });
}

__device__ inline float clamped(float x, float most) { return fminf(fmaxf(x, -most), most); }

__global__ void __launch_bounds__(kThreads) move(Fit fit, Planes planes, bool last) {
  __shared__ Shared shared;
  const Tile tile;
  float information[kTile / kTileRows], pull[kTile / kTileRows], difference[kTile / kTileRows];
  const auto sum = [&](float (&to)[kTile / kTileRows], const float* plane) {
    window(fit, tile, shared, to, [&](int y, int x) { return plane[int64_t(y) * fit.width + x]; });
  };
  sum(information, planes.information);
  sum(pull, planes.pull);
  if (last) sum(difference, planes.difference);
  for_own(fit, tile, [&](int i, int64_t pixel) {
    const bool known = fit.sixteenths[pixel] != kUnknown;
    const float start = float(known ? fit.sixteenths[pixel] : 0) * kPerSixteenth;
    const float moved = fit.px[pixel] - clamped(pull[i] / (information[i] + kResistance), kMostStep);
    const float px = start + clamped(moved - start, kMostFromStart);
    fit.px[pixel] = known ? px : 0.0f;
    if (!last) return;
    const float variance = (difference[i] + planes.known[pixel]) / fmaxf(kIndependentPixels * information[i], 1e-6f);
    fit.error_px[pixel] = known ? sqrtf(variance) : INFINITY;
  });
}

}  // namespace

void fit_on_device(const Fit& fit, CudaScratch& scratch, cudaStream_t stream) {
  const int64_t pixels = int64_t(fit.height) * fit.width;
  Planes planes = {};
  for (float** plane : {&planes.slope, &planes.known, &planes.information, &planes.pull, &planes.difference})
    *plane = scratch.array<float>(pixels);
  const dim3 tiles(blocks_for(fit.width, kTile), blocks_for(fit.height, kTile));
  prepare<<<blocks_for(pixels), kThreads, 0, stream>>>(fit, planes);
  for (int step = 0; step < kSteps; ++step) {
    weigh<<<tiles, kThreads, 0, stream>>>(fit, planes, step == 0);
    move<<<tiles, kThreads, 0, stream>>>(fit, planes, step + 1 == kSteps);
  }
}

}  // namespace gsplat::disparity_fit
