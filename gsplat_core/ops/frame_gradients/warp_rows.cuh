// Gradient rows of a warp's 32 Gaussians, summed and propagated to raw parameters. Rows are staged in shared memory, so
// that tensors with many columns are accessed coalesced.
#pragma once

#include <type_traits>

#include "chain_rule.cuh"

namespace gsplat::frame {
namespace {

constexpr unsigned kAllLanes = 0xffffffffu;
// Threads per block: 4 warps up to degree 3, and 2 at degree 4. The WarpGradients of a block must fit into 48 KiB of
// shared memory; a warp's have 11 KiB at degree 3 and 14 KiB at degree 4.
template <int kDegree>
constexpr int kSplatThreads = kDegree < 4 ? 128 : 64;

// 32 rows of kColumns floats in shared memory. Rows of whole float4s are padded to an odd number of float4s. Then
// neither eight threads accessing their own rows nor eight threads accessing consecutive float4s have bank conflicts.
template <int kColumns>
struct WarpRows {
  static constexpr bool kQuads = kColumns % 4 == 0;
  static constexpr int kGap = kQuads && kColumns / 4 % 2 == 0 ? 4 : 0, kStride = kColumns + kGap;
  alignas(16) float values[32 * kStride];

  // Index of value i of the unpadded rows.
  __device__ static int index_of(int i) { return kGap == 0 ? i : i + i / kColumns * kGap; }
  __device__ float4& quad(int i) { return *reinterpret_cast<float4*>(values + index_of(4 * i)); }

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

// Call quad(i) for the whole float4s of the warp's `rows` rows, and single(i) for the remaining values, distributed
// over the lanes.
template <int kColumns, class Quad, class Single>
__device__ inline void for_each_value(int rows, int lane, const Quad& quad, const Single& single) {
  const int values = rows * kColumns;
#pragma unroll 4
  for (int i = lane; i < values / 4; i += 32) quad(i);
  if constexpr (kColumns % 4 != 0) {
    const int left = values / 4 * 4 + lane;
    if (left < values) single(left);
  }
}

// Start an asynchronous copy of kBytes to shared memory; wait_for_copies completes it.
template <int kBytes>
__device__ inline void start_copy(void* to, const void* from) {
  const unsigned at = unsigned(__cvta_generic_to_shared(to));
  if constexpr (kBytes == 16) {
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(at), "l"(from) : "memory");
  } else {
    asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" ::"r"(at), "l"(from) : "memory");
  }
}
__device__ inline void wait_for_copies() {
  asm volatile("cp.async.wait_all;" ::: "memory");
  __syncwarp();
}

// Start copying the rows with a bit in `selected`; other rows may be copied, too. `aligned`: `from` is aligned to 16
// bytes, so that 16 bytes can be copied at a time.
template <int kColumns>
__device__ inline void start_copy(WarpRows<kColumns>& to, const float* from, int rows, unsigned selected, bool aligned,
                                  int lane) {
  const auto is_selected = [&](int value) { return (selected >> (value / kColumns) & 1) != 0; };
  const auto quad = [&](int i) {
    if (is_selected(4 * i) || (kColumns % 4 != 0 && is_selected(4 * i + 3))) start_copy<16>(&to.quad(i), from + 4 * i);
  };
  const auto single = [&](int i) { start_copy<4>(to.values + to.index_of(i), from + i); };
  if (aligned) {
    for_each_value<kColumns>(rows, lane, quad, single);
  } else {
    for (int i = lane; i < rows * kColumns; i += 32) single(i);
  }
}

template <int kColumns>
__device__ inline void write_rows(WarpRows<kColumns>& from, float* to, int rows, int lane) {
  for_each_value<kColumns>(
      rows, lane, [&](int i) { reinterpret_cast<float4*>(to)[i] = from.quad(i); }, [&](int i) { to[i] = from.values[i]; });
}

// Gradient rows staged in shared memory; the rows of a warp's Gaussians are contiguous.
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

// Return to each lane the sum of `count` rows from `start` on, in an order that depends only on the counts. A lane adds
// its rows sequentially; the whole warp adds the rows of a splat with very many. A lane without rows must have the
// start of the next lane that has rows.
__device__ inline SplatRow sum_rows(const float4* rows, int start, int count, int lane, StagedRows& staged) {
  constexpr int kManyRows = 64;
  SplatRow sum = {};
  const unsigned long_splats = __ballot_sync(kAllLanes, count > kManyRows);
  if (long_splats == 0) {
    const int first = __shfl_sync(kAllLanes, start, 0), end = __reduce_max_sync(kAllLanes, start + count);
    for (int base = first; base < end; base += StagedRows::kCount) {
      const int staged_count = min(end - base, StagedRows::kCount);
      __syncwarp();
      for (int i = lane; i < staged_count * kRowQuads; i += 32)
        start_copy<16>(staged.quads + i, rows + int64_t(base) * kRowQuads + i);
      wait_for_copies();
      const int to = min(start + count, base + staged_count);
      for (int i = max(start, base); i < to; ++i) add_row(staged.quads + (i - base) * kRowQuads, sum);
    }
    __syncwarp();
    return sum;
  }
  if (count <= kManyRows) {
#pragma unroll 4
    for (int i = 0; i < count; ++i) add_row(rows + int64_t(start + i) * kRowQuads, sum);
  }
  for (unsigned left = long_splats; left != 0; left &= left - 1) {
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

// Add a raw row, except for its colours, to another one.
__device__ inline void add_geometry(const float* added, float (&row)[kRawColumns]) {
  static_assert(kRawColor == 10 && kRawOpacity == 13);
  const float4* const quads = reinterpret_cast<const float4*>(added);
  const float4 a = quads[0], b = quads[1], c = quads[2], d = quads[3];
  const float values[kRawColor] = {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, c.x, c.y};
  for (int k = 0; k < kRawColor; ++k) row[k] += values[k];
  row[kRawOpacity] += d.y;
}

// Results of a warp: the raw gradients of its 32 Gaussians, and the coefficients' gradients, which overwrite
// the coefficients.
template <int kDegree>
struct WarpGradients {
  static constexpr int kHarmonics = 3 * kBasesOf<kDegree>;
  WarpRows<kHarmonics> sh;
  union {
    StagedRows instances;
    WarpRows<kRawColumns> raw;
  };

  // Compute the gradients of `rows` Gaussians from `first` on.
  __device__ void compute(const Scene& scene, const Camera& camera, const Lists& lists, const PictureGradient& from,
                          int64_t first, int rows, int lane) {
    const int64_t n = first + min(lane, rows - 1);
    const bool cut = lists.status[kStatusOverflow] != 0;
    const int start = lists.splat_starts[n], end = lists.splat_starts[n + 1], count = lane < rows && !cut ? end - start : 0;
    const RawGaussian gaussian = load_gaussian(scene, n);
    const unsigned visible = __ballot_sync(kAllLanes, count > 0);
    start_copy(sh, scene.sh + first * kHarmonics, rows, visible, scene.aligned, lane);
    SplatRow sum = {};
    if (from.atomic) {
      if (count > 0) add_row(from.rows + n * kRowQuads, sum);
    } else if (visible != 0) {
      sum = sum_rows(from.rows, start, count, lane, instances);
    }
    const bool corrects = kDegree == 0 && from.correction.residuals != nullptr;
    const float weight = sum.colors[3];  // sum of the weights for colour corrections, otherwise dL/dz
    if (corrects) sum.colors[3] = 0;
    RawGradient g = {};
    if (count > 0) g = projection_gradient(scene, camera, gaussian, sum);
    wait_for_copies();
    float c[kHarmonics] = {};
    if (count > 0) {
      sh.get(lane, c);
      if (corrects) {
        colour_correction(gaussian, sum.colors, weight, *from.correction.relaxation, c, g);
        for (float& value : c) value = 0;
      } else {
        harmonics_gradient<kDegree>(camera, gaussian, sum.colors, c, g);
      }
    }
    sh.put(lane, c);
    float row[kRawColumns] = {};
    for (int k = 0; k < 3; ++k) row[kRawPosition + k] = g.mean[k];
    for (int k = 0; k < 4; ++k) row[kRawRotation + k] = g.quat[k];
    for (int k = 0; k < 3; ++k) row[kRawLogScale + k] = g.log_scales[k];
    for (int k = 0; k < 3; ++k) row[kRawColor + k] = g.color[k];
    row[kRawOpacity] = g.logit;
    if (from.added != nullptr && lane < rows && !cut) add_geometry(from.added + kRawColumns * n, row);
    raw.put(lane, row);
  }
};

// Call run with the degree, as a constant, of a number of bases that the host has checked.
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

}  // namespace gsplat::frame
