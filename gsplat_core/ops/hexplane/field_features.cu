#include "plane_samples.cuh"
#include "team_launch.h"
#include "training_cuda.h"

using namespace hexplane;

namespace {

// A team has one Gaussian at one level.
template <int kLane, int kTeam>
__global__ void __launch_bounds__(kThreads, 3)
    features_kernel(FieldPlanes planes, FieldLines lines, FieldCells cells, float* __restrict__ features) {
  const int64_t n = (int64_t(blockIdx.x) * kThreads + threadIdx.x) / kTeam;
  if (n >= cells.count) return;
  const int level = int(blockIdx.y), channels = planes.channels;
  const float4 at4 = *reinterpret_cast<const float4*>(cells.coordinates + 4 * n);
  const int32_t* sizes = planes.sizes[level];
  const LinePosition places[3] = {position_on(at4.x, sizes[0]), position_on(at4.y, sizes[1]), position_on(at4.z, sizes[2])};
  float* out = features + (n * planes.levels + level) * channels;
  const float* values = static_cast<const float*>(lines.values);
  for (int c = int(threadIdx.x) % kTeam * kLane; c < channels; c += kTeam * kLane) {
    Channels<kLane> value = Channels<kLane>::all(at4.w);
#pragma unroll
    for (int p = 0; p < 3; ++p) {
      const FeaturePlane plane = planes.plane(level, p);
      const Corners at(plane, places[u_axis(p)], places[v_axis(p)], channels);
      value = value * Sample<kLane>(plane.values, at, c).value(at);
    }
#pragma unroll
    for (int axis = 0; axis < 3; ++axis) {
      const float* left = values + lines.starts[level][axis] + int32_t(places[axis].cell) * channels + c;
      const float* right = left + (planes.sizes[level][axis] > 1 ? channels : 0);
      value = value * between(Channels<kLane>::load(left), Channels<kLane>::load(right), places[axis].fraction);
    }
    value.store(out + c);
  }
}

// A team has one Gaussian at all levels, so that the gradient of its position has one sum. Teams take Gaussians in the order of
// the first plane's cells, where neighbours read the same nodes.
template <int kLane, int kTeam>
__global__ void __launch_bounds__(kThreads, 2)
    rows_kernel(FieldPlanes planes, FieldLines lines, FieldCells cells, const float* __restrict__ box,
                const float* __restrict__ v_features, FieldRows rows, float* v_raw) {
  const int64_t index = (int64_t(blockIdx.x) * kThreads + threadIdx.x) / kTeam;
  const int64_t item = index < cells.count ? cells.items[index] : cells.count;  // behind the first plane's items come others
  const bool inside = item < cells.count;
  const int64_t n = inside ? item : 0;  // lanes without a Gaussian take part in the sums
  const int lane = int(threadIdx.x) % kTeam, channels = planes.channels;
  const float4 at4 = *reinterpret_cast<const float4*>(cells.coordinates + 4 * n);
  const bool active = inside && at4.w != 0.0f;
  const float* values = static_cast<const float*>(lines.values);
  float v_x[3] = {};
  for (int level = 0; level < planes.levels && active; ++level) {
    int32_t ranks[3];
#pragma unroll
    for (int p = 0; p < 3; ++p) ranks[p] = cells.ranks[(3 * level + p) * cells.count + n];
    const int32_t* sizes = planes.sizes[level];
    const LinePosition places[3] = {position_on(at4.x, sizes[0]), position_on(at4.y, sizes[1]), position_on(at4.z, sizes[2])};
    float v_place[3] = {};  // the gradient of the place in cells
    for (int c = lane * kLane; c < channels; c += kTeam * kLane) {
      const auto v = Channels<kLane>::load(v_features + (n * planes.levels + level) * channels + c);
      Channels<kLane> value[6], along_u[6], along_v[3];
#pragma unroll
      for (int p = 0; p < 3; ++p) {
        const FeaturePlane plane = planes.plane(level, p);
        const Corners at(plane, places[u_axis(p)], places[v_axis(p)], channels);
        Sample<kLane>(plane.values, at, c).value_and_slopes(at, value[p], along_u[p], along_v[p]);
      }
#pragma unroll
      for (int axis = 0; axis < 3; ++axis) {
        const float* left = values + lines.starts[level][axis] + int32_t(places[axis].cell) * channels + c;
        const auto a = Channels<kLane>::load(left), b = Channels<kLane>::load(left + (sizes[axis] > 1 ? channels : 0));
        along_u[3 + axis] = b - a;
        value[3 + axis] = plus(a, places[axis].fraction, along_u[3 + axis]);
      }
      Channels<kLane> before[6], after = Channels<kLane>::all(1.0f);
      before[0] = v;
#pragma unroll
      for (int p = 1; p < 6; ++p) before[p] = before[p - 1] * value[p - 1];
#pragma unroll
      for (int p = 5; p >= 0; --p) {
        const Channels<kLane> g = before[p] * after;
        after = after * value[p];
        g.store((p < 3 ? rows.space : rows.lines) + int64_t(ranks[p < 3 ? p : plane_of_major(p - 3)]) * channels + c);
        if (p < 3) {
          v_place[u_axis(p)] += (g * along_u[p]).sum();
          v_place[v_axis(p)] += (g * along_v[p]).sum();
        } else {
          v_place[p - 3] += (g * along_u[p]).sum();
        }
      }
    }
#pragma unroll
    for (int axis = 0; axis < 3; ++axis) v_x[axis] += v_place[axis] * places[axis].slope;
    // After the loads of the level, none of which may pass a store.
#pragma unroll
    for (int p = 0; p < 3; ++p) {
      if (lane != p) continue;
      *reinterpret_cast<float2*>(rows.shares + 2 * int64_t(ranks[p])) =
          make_float2(places[major_axis(p)].fraction, places[minor_axis(p)].fraction);
    }
  }
#pragma unroll
  for (int axis = 0; axis < 3; ++axis) {
    const float sum = team_sum<kTeam>(v_x[axis]);
    if (lane == axis && active) v_raw[n * kRawColumns + kRawPosition + axis] += sum * 2.0f / (box[3 + axis] - box[axis]);
  }
}

bool wide(const FieldPlanes& planes, const FieldLines& lines) {
  uintptr_t bits = uintptr_t(planes.channels) * 4 | uintptr_t(lines.values);
  for (int l = 0; l < planes.levels; ++l)
    for (const float* plane : planes.space[l]) bits |= uintptr_t(plane);
  return bits % 16 == 0;
}

}  // namespace

void field_features(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, float* features,
                    cudaStream_t stream) {
  if (cells.count == 0) return;
  with_team(wide(planes, lines), planes.channels, [&](auto lane, auto team) {
    const dim3 grid(blocks_for(cells.count * team()), unsigned(planes.levels));
    features_kernel<lane(), team()><<<grid, kThreads, 0, stream>>>(planes, lines, cells, features);
  });
}

void field_rows(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const float* box,
                const float* v_features, const FieldRows& rows, float* v_raw, cudaStream_t stream) {
  if (cells.count == 0) return;
  with_team(wide(planes, lines), planes.channels, [&](auto lane, auto team) {
    rows_kernel<lane(), team()>
        <<<blocks_for(cells.count * team()), kThreads, 0, stream>>>(planes, lines, cells, box, v_features, rows, v_raw);
  });
}
