// The rows of a warp's 32 Gaussians in shared memory, so that tensors with many columns are read and written as they lie.
#pragma once

#include "frame_gradients_splat.cuh"

namespace {

constexpr unsigned kAllLanes = 0xffffffffu;
// Of a block: as many warps as its shared memory has room for.
template <int kDegree>
constexpr int kSplatThreads = kDegree < 4 ? 128 : 64;

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

// Starts copying to shared memory; what was started is there after copies_done().
template <int kBytes>
__device__ inline void start_copy(void* to, const void* from) {
  const unsigned at = unsigned(__cvta_generic_to_shared(to));
  if constexpr (kBytes == 16) {
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(at), "l"(from) : "memory");
  } else {
    asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" ::"r"(at), "l"(from) : "memory");
  }
}
__device__ inline void copies_done() {
  asm volatile("cp.async.wait_all;" ::: "memory");
  __syncwarp();
}

// The rows that `wanted` has a bit for; `aligned`: `from` is at a multiple of 16 bytes.
template <int kColumns>
__device__ inline void start_copy(WarpRows<kColumns>& to, const float* from, int rows, unsigned wanted, bool aligned, int lane) {
  const auto wants = [&](int value) { return (wanted >> (value / kColumns) & 1) != 0; };
  const auto quad = [&](int i) {
    if (wants(4 * i) || (kColumns % 4 != 0 && wants(4 * i + 3))) start_copy<16>(&to.quad(i), from + 4 * i);
  };
  const auto single = [&](int i) { start_copy<4>(to.values + to.place(i), from + i); };
  if (aligned) {
    each_value<kColumns>(rows, lane, quad, single);
  } else {
    for (int i = lane; i < rows * kColumns; i += 32) single(i);
  }
}

template <int kColumns>
__device__ inline void write_rows(WarpRows<kColumns>& from, float* to, int rows, int lane) {
  each_value<kColumns>(
      rows, lane, [&](int i) { reinterpret_cast<float4*>(to)[i] = from.quad(i); }, [&](int i) { to[i] = from.values[i]; });
}

// Rows of instances on their way to a warp's sums: those of a warp's Gaussians lie together.
struct StagedRows {
  static constexpr int kCount = 96;
  float4 quads[kCount * kRowQuads];
};

__device__ inline void add_row(const float4* row, SplatRow& sum) {
  const float4 a = row[0], b = row[1];
  const float2 c = *reinterpret_cast<const float2*>(row + 2);
  const float values[10] = {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, c.x, c.y};
  for (int i = 0; i < 6; ++i) sum.moments[i] += values[i];
  for (int i = 0; i < 4; ++i) sum.colors[i] += values[6 + i];
}

// The sum of `count` rows from `start` on for each lane, in an order that depends on their number alone: one after the other, but
// where there are very many the whole warp adds them up. Lanes without any have the start of the next one that has.
__device__ inline SplatRow sum_rows(const float4* rows, int start, int count, int lane, StagedRows& staged) {
  constexpr int kMany = 64;
  SplatRow sum = {};
  const unsigned many = __ballot_sync(kAllLanes, count > kMany);
  if (many == 0) {
    const int first = __shfl_sync(kAllLanes, start, 0), end = __reduce_max_sync(kAllLanes, start + count);
    for (int base = first; base < end; base += StagedRows::kCount) {
      const int staged_count = min(end - base, StagedRows::kCount);
      __syncwarp();
      for (int i = lane; i < staged_count * kRowQuads; i += 32)
        start_copy<16>(staged.quads + i, rows + int64_t(base) * kRowQuads + i);
      copies_done();
      const int to = min(start + count, base + staged_count);
      for (int i = max(start, base); i < to; ++i) add_row(staged.quads + (i - base) * kRowQuads, sum);
    }
    __syncwarp();
    return sum;
  }
  if (count <= kMany) {
#pragma unroll 4
    for (int i = 0; i < count; ++i) add_row(rows + int64_t(start + i) * kRowQuads, sum);
  }
  for (unsigned left = many; left != 0; left &= left - 1) {
    const int owner = __ffs(int(left)) - 1;
    const int first = __shfl_sync(kAllLanes, start, owner), all = __shfl_sync(kAllLanes, count, owner);
    SplatRow part = {};
#pragma unroll 4
    for (int i = lane; i < all; i += 32) add_row(rows + int64_t(first + i) * kRowQuads, part);
    for (int half = 16; half > 0; half /= 2) {
      for (float& value : part.moments) value += __shfl_xor_sync(kAllLanes, value, half);
      for (float& value : part.colors) value += __shfl_xor_sync(kAllLanes, value, half);
    }
    if (lane == owner) sum = part;
  }
  return sum;
}

// What a warp computes: the raw gradients of its Gaussians, and those of their coefficients in the place of these.
template <int kDegree>
struct WarpGradients {
  static constexpr int kHarmonics = 3 * kBasesOf<kDegree>;
  WarpRows<kHarmonics> sh;
  union {
    StagedRows instances;
    WarpRows<kRawColumns> raw;
  };

  // `rows` Gaussians from `first` on.
  __device__ void compute(const FrameScene& scene, const FrameCamera& camera, const FrameLists& lists, const FrameGradients& from,
                          int64_t first, int rows, int lane) {
    const int64_t n = first + min(lane, rows - 1);
    const bool cut = lists.status[kStatusCut] != 0;
    const int start = lists.splat_starts[n], end = lists.splat_starts[n + 1], count = lane < rows && !cut ? end - start : 0;
    const RawGaussian gaussian = load_gaussian(scene, n);
    const unsigned seen = __ballot_sync(kAllLanes, count > 0);
    start_copy(sh, scene.sh + first * kHarmonics, rows, seen, scene.aligned, lane);
    SplatRow sum = {};
    if (from.by_arrival) {
      if (count > 0) add_row(from.rows + n * kRowQuads, sum);
    } else if (seen != 0) {
      sum = sum_rows(from.rows, start, count, lane, instances);
    }
    RawGradient g = {};
    if (count > 0) g = projection_gradient(scene, camera, gaussian, sum);
    copies_done();
    float c[kHarmonics] = {};
    if (count > 0) {
      sh.get(lane, c);
      harmonics_gradient<kDegree>(camera, gaussian, sum.colors, c, g);
    }
    sh.put(lane, c);
    float row[kRawColumns] = {};
    for (int k = 0; k < 3; ++k) row[kRawPosition + k] = g.mean[k];
    for (int k = 0; k < 4; ++k) row[kRawRotation + k] = g.quat[k];
    for (int k = 0; k < 3; ++k) row[kRawLogScale + k] = g.log_scales[k];
    for (int k = 0; k < 3; ++k) row[kRawColor + k] = g.color[k];
    row[kRawOpacity] = g.logit;
    raw.put(lane, row);
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
