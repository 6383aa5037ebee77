// From costs and messages to disparities: one warp finds the best disparity of a pixel, followed by the left-right
// consistency check.
#include "cuda_check.h"
#include "cuda_scratch.h"
#include "volume.cuh"

namespace gsplat::stereo_matching {
namespace {

constexpr uint32_t kNone = ~0u;

// Find the best disparity of each pixel in 1/16 pixel. For the matching pixel of the right image, also store the
// minimum key of all pixels matched with it. A key is a total cost combined with the disparity number, so that ties
// resolve to the lowest disparity.
template <int kEach>
__global__ void __launch_bounds__(kThreads)
    find_best(Pair pair, const uint8_t* costs, const uint8_t* messages, int32_t* sixteenths, uint32_t* right) {
  using Bytes = typename Packed<kEach>::type;
  const int lane = threadIdx.x % 32;
  const int64_t pixels = int64_t(pair.height) * pair.width;
  const int64_t pixel = int64_t(blockIdx.x) * (kThreads / 32) + threadIdx.x / 32;
  if (pixel >= pixels) return;
  const int64_t at = pixel * pair.count + lane * kEach, volume = pixels * pair.count;
  const bool used = lane * kEach < pair.count;
  const auto bytes = [&](const uint8_t* from) { return used ? *reinterpret_cast<const Bytes*>(from + at) : Bytes(0); };
  const Bytes cost = bytes(costs);
  Bytes message[kPaths];
#pragma unroll
  for (int path = 0; path < kPaths; ++path) message[path] = bytes(messages + path * volume);
  uint32_t total[kEach], key = kNone;
#pragma unroll
  for (int k = 0; k < kEach; ++k) {
    total[k] = kPaths * uint32_t(byte_of<kEach>(cost, k));
#pragma unroll
    for (int path = 0; path < kPaths; ++path) total[k] += uint32_t(byte_of<kEach>(message[path], k));
    if (used) key = min(key, total[k] << 8 | uint32_t(lane * kEach + k));
  }
  key = __reduce_min_sync(kAllLanes, key);
  const uint32_t least = key >> 8;
  const int best = int(key & 255);
  uint32_t beside = 0;  // total costs below and above the best disparity
  bool rival = false;
#pragma unroll
  for (int k = 0; k < kEach; ++k) {
    const int away = lane * kEach + k - best;
    if (away == -1) beside |= total[k];
    if (away == 1) beside |= total[k] << 16;
    if (abs(away) > 1) rival |= used && total[k] * (100 - kUniquenessPercent) < least * 100;
  }
  beside = __reduce_or_sync(kAllLanes, beside);
  const bool known = !__any_sync(kAllLanes, rival);
  if (lane != 0) return;
  int within = 0;
  if (best > 0 && best < pair.count - 1) {  // vertex of a parabola
    const int below = int(beside & 0xffff), above = int(beside >> 16), bend = max(below + above - 2 * int(least), 1);
    within = ((below - above) * kSixteenths + bend) / (2 * bend);
  }
  sixteenths[pixel] = known ? kSixteenths * (pair.lowest + best) + within : kUnknown;
  const int64_t x = pixel % pair.width, there = x - pair.lowest - best;
  if (known && there >= 0 && there < pair.width) atomicMin(right + pixel - x + there, key);
}

// Return true if the matching pixel of the right image prefers another disparity; false if it has none.
__device__ inline bool differs(const Pair& pair, const uint32_t* row, int x, int disparity) {
  const int there = x - disparity;
  if (there < 0 || there >= pair.width || row[there] == kNone) return false;
  return abs(pair.lowest + int(row[there] & 255) - disparity) > kLeftRightMost;
}

__global__ void __launch_bounds__(kThreads) check_from_right(Pair pair, const uint32_t* right, int32_t* sixteenths) {
  const int64_t pixel = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (pixel >= int64_t(pair.height) * pair.width || sixteenths[pixel] == kUnknown) return;
  const int x = int(pixel % pair.width), found = sixteenths[pixel], there = kSixteenths * x - found;
  const uint32_t* const row = right + pixel - x;
  const bool outside = there < 0 || there > kSixteenths * (pair.width - 1);
  const int below = found >> 4, above = (found + kSixteenths - 1) >> 4;
  if (outside || (differs(pair, row, x, below) && differs(pair, row, x, above))) sixteenths[pixel] = kUnknown;
}

__global__ void __launch_bounds__(kThreads) find_surfaces(Pair pair, Matched matched) {
  const int64_t pixel = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (pixel >= int64_t(pair.height) * pair.width) return;
  const int y = int(pixel / pair.width), x = int(pixel % pair.width);
  int least = INT_MAX, most = kUnknown;
  bool hole = false;
  for (int row = max(y - kJumpRadius, 0); row <= min(y + kJumpRadius, pair.height - 1); ++row) {
    for (int column = max(x - kJumpRadius, 0); column <= min(x + kJumpRadius, pair.width - 1); ++column) {
      const int found = matched.sixteenths[int64_t(row) * pair.width + column];
      hole |= found == kUnknown && abs(row - y) <= kHoleRadius && abs(column - x) <= kHoleRadius;
      if (found != kUnknown) least = min(least, found), most = max(most, found);
    }
  }
  matched.one_surface[pixel] = !hole && most - least <= kJumpMost;
}

}  // namespace

void choose(const Pair& pair, const uint8_t* costs, const uint8_t* messages, int32_t* sixteenths, CudaScratch& scratch,
            cudaStream_t stream) {
  const int64_t pixels = int64_t(pair.height) * pair.width;
  uint32_t* const right = scratch.array<uint32_t>(pixels);
  check_cuda(cudaMemsetAsync(right, 0xff, size_t(pixels) * sizeof(uint32_t), stream), "setting memory to none");
  with_each(pair.count, [&](auto each) {
    find_best<each.value><<<blocks_for(pixels, kThreads / 32), kThreads, 0, stream>>>(pair, costs, messages, sixteenths, right);
  });
  check_from_right<<<blocks_for(pixels), kThreads, 0, stream>>>(pair, right, sixteenths);
}

void match_on_device(const Pair& pair, const Matched& matched, CudaScratch& scratch, cudaStream_t stream) {
  const int64_t pixels = int64_t(pair.height) * pair.width;
  uint8_t* const costs = scratch.array<uint8_t>(pixels * pair.count);
  uint8_t* const messages = scratch.array<uint8_t>(kPaths * pixels * pair.count);
  // The sums use the messages' memory, which is free until the paths run.
  sum_costs(pair, costs, reinterpret_cast<uint16_t*>(messages), scratch, stream);
  follow_paths(pair, costs, messages, stream);
  choose(pair, costs, messages, matched.sixteenths, scratch, stream);
  drop_patches(pair, matched.sixteenths, scratch, stream);
  find_surfaces<<<blocks_for(pixels), kThreads, 0, stream>>>(pair, matched);
}

}  // namespace gsplat::stereo_matching
