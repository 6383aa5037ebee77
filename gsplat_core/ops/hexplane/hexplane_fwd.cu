#include "hexplane_cuda.h"
#include "plane_samples.cuh"
#include "team_launch.h"

using namespace hexplane;

namespace {

template <int kLane, int kTeam>
__global__ void __launch_bounds__(kThreads) product(HexPlanes level, int first, int last, float* features, int64_t count) {
  const int64_t n = (int64_t(blockIdx.x) * kThreads + threadIdx.x) / kTeam;
  if (n >= count) return;
  const float* x = level.coordinates + 4 * n;
  const int channels = int(level.channels);
  for (int c = int(threadIdx.x) % kTeam * kLane; c < channels; c += kTeam * kLane) {
    Channels<kLane> value = Channels<kLane>::all(1.0f);
#pragma unroll
    for (int p = 0; p < kPlanes; ++p) {
      if (p < first || p >= last) continue;
      const Corners at(level.planes[p], x[u_axis(p)], x[v_axis(p)], channels);
      value = value * Sample<kLane>(level.planes[p].values, at, c).value(at);
    }
    value.store(features + n * channels + c);
  }
}

template <int kLane, int kTeam>
__global__ void __launch_bounds__(kThreads) modulate(HexPlanes level, const float* space, float* features, int64_t count) {
  const int64_t n = (int64_t(blockIdx.x) * kThreads + threadIdx.x) / kTeam;
  if (n >= count) return;
  const int channels = int(level.channels);
  for (int c = int(threadIdx.x) % kTeam * kLane; c < channels; c += kTeam * kLane) {
    Channels<kLane> value = Channels<kLane>::load(space + n * channels + c);
#pragma unroll
    for (int axis = 0; axis < 3; ++axis) {
      const FeaturePlane& line = level.planes[axis];
      const LinePosition at = position_on(level.coordinates[4 * n + axis], line.width);
      const float* left = line.values + at.cell * channels + c;
      const float* right = left + (line.width > 1 ? channels : 0);
      value = value * between(Channels<kLane>::load(left), Channels<kLane>::load(right), at.fraction);
    }
    value.store(features + n * channels + c);
  }
}

// Whether every row of channels starts at 16 bytes.
bool wide(const HexPlanes& level, int planes, const void* a, const void* b) {
  uintptr_t bits = uintptr_t(level.channels) * 4 | uintptr_t(a) | uintptr_t(b);
  for (int p = 0; p < planes; ++p) bits |= uintptr_t(level.planes[p].values);
  return bits % 16 == 0;
}

}  // namespace

void plane_product(const HexPlanes& level, int first, int last, float* features, int64_t count, cudaStream_t stream) {
  if (count == 0) return;
  with_team(wide(level, last, features, nullptr), level.channels, [&](auto lane, auto team) {
    product<lane(), team()><<<blocks_for(count * team()), kThreads, 0, stream>>>(level, first, last, features, count);
  });
}

void modulate_lines(const HexPlanes& level, const float* space, float* features, int64_t count, cudaStream_t stream) {
  if (count == 0) return;
  with_team(wide(level, 3, space, features), level.channels, [&](auto lane, auto team) {
    modulate<lane(), team()><<<blocks_for(count * team()), kThreads, 0, stream>>>(level, space, features, count);
  });
}
