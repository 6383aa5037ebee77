// The rows of a warp's 32 Gaussians in shared memory, so that tensors with many columns are read and written as they lie.
#pragma once

#include "frame_gradients_splat.cuh"

namespace {

constexpr int kSplatThreads = 128;
constexpr int kSplatWarps = kSplatThreads / 32;

// 32 rows of kColumns floats. Rows of whole float4s are kept an odd number of them apart: then neither the rows of eight threads
// nor eight float4s in a row meet in a bank.
template <int kColumns>
struct WarpRows {
  static constexpr bool kQuads = kColumns % 4 == 0;
  static constexpr int kGap = kQuads && kColumns / 4 % 2 == 0 ? 4 : 0, kStride = kColumns + kGap;
  alignas(16) float values[32 * kStride];

  // Where value i of the 32 rows is.
  __device__ static int place(int i) { return kGap == 0 ? i : i + i / kColumns * kGap; }
  __device__ float4& quad(int i) { return *reinterpret_cast<float4*>(values + place(4 * i)); }

  __device__ void get(int row, float (&v)[kColumns]) const {
    const float* const from = values + row * kStride;
    if constexpr (kQuads) {
#pragma unroll
      for (int i = 0; i < kColumns / 4; ++i) {
        const float4 q = reinterpret_cast<const float4*>(from)[i];
        v[4 * i] = q.x, v[4 * i + 1] = q.y, v[4 * i + 2] = q.z, v[4 * i + 3] = q.w;
      }
    } else {
#pragma unroll
      for (int i = 0; i < kColumns; ++i) v[i] = from[i];
    }
  }
  __device__ void put(int row, const float (&v)[kColumns]) {
    float* const to = values + row * kStride;
    if constexpr (kQuads) {
#pragma unroll
      for (int i = 0; i < kColumns / 4; ++i)
        reinterpret_cast<float4*>(to)[i] = make_float4(v[4 * i], v[4 * i + 1], v[4 * i + 2], v[4 * i + 3]);
    } else {
#pragma unroll
      for (int i = 0; i < kColumns; ++i) to[i] = v[i];
    }
  }
};

// Runs over the values of `rows` rows of the warp: whole float4s, then what is left of the last one.
template <int kColumns, class Quad, class Single>
__device__ inline void each_value(int rows, int lane, const Quad& quad, const Single& single) {
  const int values = rows * kColumns;
#pragma unroll 4
  for (int i = lane; i < values / 4; i += 32) quad(i);
  if constexpr (kColumns % 4 != 0) {
    const int left = values / 4 * 4 + lane;
    if (left < values) single(left);
  }
}

// Starts copying the rows that `wanted` has a bit for; they are there after copies_done().
template <int kColumns>
__device__ inline void start_copy(WarpRows<kColumns>& to, const float* from, int rows, unsigned wanted, int lane) {
  const unsigned at = unsigned(__cvta_generic_to_shared(to.values));
  const auto wants = [&](int value) { return (wanted >> (value / kColumns) & 1) != 0; };
  each_value<kColumns>(
      rows, lane,
      [&](int i) {
        if (wants(4 * i) || wants(4 * i + 3))
          asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(at + 4 * to.place(4 * i)), "l"(from + 4 * i));
      },
      [&](int i) { asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" ::"r"(at + 4 * i), "l"(from + i)); });
}
__device__ inline void copies_done() {
  asm volatile("cp.async.wait_all;" ::: "memory");
  __syncwarp();
}

template <int kColumns>
__device__ inline void write_rows(WarpRows<kColumns>& from, float* to, int rows, int lane) {
  each_value<kColumns>(
      rows, lane, [&](int i) { reinterpret_cast<float4*>(to)[i] = from.quad(i); }, [&](int i) { to[i] = from.values[i]; });
}

// What a warp computes: the raw gradients of its Gaussians, and those of their coefficients in the place of these.
template <int kDegree>
struct WarpGradients {
  static constexpr int kHarmonics = 3 * kBasesOf<kDegree>;
  WarpRows<kHarmonics> sh;
  WarpRows<kRawColumns> raw;

  // `rows` Gaussians from `first` on.
  __device__ void compute(const FrameScene& scene, const FrameLists& lists, const float4* instance_rows, int64_t first, int rows,
                          int lane) {
    const int64_t n = first + lane;
    const bool usable = lane < rows && lists.status[kStatusCut] == 0;
    const int start = usable ? lists.splat_starts[n] : 0;
    const int count = usable ? lists.splat_starts[n + 1] - start : 0;
    start_copy(sh, scene.sh + first * kHarmonics, rows, __ballot_sync(kAllLanes, count > 0), lane);
    const SplatRow sum = sum_rows(instance_rows, start, count, lane);
    SeenSplat splat;
    RawGradient g = {};
    if (count > 0) {
      splat = seen_splat(scene, n);
      g = projection_gradient(scene, splat, sum);
    }
    copies_done();
    float c[kHarmonics] = {};
    if (count > 0) {
      sh.get(lane, c);
      harmonics_gradient<kDegree>(scene, splat, sum.colors, c, g);
    }
    sh.put(lane, c);
    raw.put(lane, {g.mean[0], g.mean[1], g.mean[2], g.quat[0], g.quat[1], g.quat[2], g.quat[3], g.log_scales[0], g.log_scales[1],
                   g.log_scales[2], g.color[0], g.color[1], g.color[2], g.logit, 0, 0});
  }
};

// run(degree) for the number of bases; the host has checked it.
template <class Run>
void with_degree(int bases, const Run& run) {
  switch (bases) {
    case 1: return run(std::integral_constant<int, 0>());
    case 4: return run(std::integral_constant<int, 1>());
    case 9: return run(std::integral_constant<int, 2>());
    case 16: return run(std::integral_constant<int, 3>());
    default: return run(std::integral_constant<int, 4>());
  }
}

}  // namespace
