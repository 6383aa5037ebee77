// Bilinear samples of channels-last planes, with a team of lanes per point that share the channels. Also the gradient
// of one node of a plane: the sum of the gradient rows of the Gaussians in the four surrounding cells, in sorted order.
#pragma once

#include <type_traits>

#include "hexplane.h"
#include "line_position.h"

namespace gsplat::hexplane {

using GSPLAT_ISA::hexplane::LinePosition;
using GSPLAT_ISA::hexplane::position_on;

// kPlaneAxes for device code, which cannot index the host constant.
constexpr int u_axis(int plane) { return plane == 2 || plane == 4 ? 1 : plane == 5 ? 2 : 0; }
constexpr int v_axis(int plane) { return plane == 0 ? 1 : plane < 3 ? 2 : 3; }

// Consecutive channels per lane: 4 if the number of channels is a multiple of 4 and memory is aligned, otherwise 1.
template <int kLane>
struct Channels {
  float v[kLane];

  __device__ static Channels load(const float* p) {
    Channels out;
    if constexpr (kLane == 4) {
      const float4 x = *reinterpret_cast<const float4*>(p);
      out.v[0] = x.x, out.v[1] = x.y, out.v[2] = x.z, out.v[3] = x.w;
    } else {
      out.v[0] = *p;
    }
    return out;
  }
  __device__ void store(float* p) const {
    if constexpr (kLane == 4) {
      *reinterpret_cast<float4*>(p) = make_float4(v[0], v[1], v[2], v[3]);
    } else {
      *p = v[0];
    }
  }
  __device__ static Channels all(float x) {
    Channels out;
    for (int i = 0; i < kLane; ++i) out.v[i] = x;
    return out;
  }
  __device__ float sum() const {
    float total = v[0];
    for (int i = 1; i < kLane; ++i) total += v[i];
    return total;
  }
};

template <int kLane>
__device__ __forceinline__ Channels<kLane> operator*(const Channels<kLane>& a, const Channels<kLane>& b) {
  Channels<kLane> out;
#pragma unroll
  for (int i = 0; i < kLane; ++i) out.v[i] = a.v[i] * b.v[i];
  return out;
}

template <int kLane>
__device__ __forceinline__ Channels<kLane> operator-(const Channels<kLane>& a, const Channels<kLane>& b) {
  Channels<kLane> out;
#pragma unroll
  for (int i = 0; i < kLane; ++i) out.v[i] = a.v[i] - b.v[i];
  return out;
}

// a + t b
template <int kLane>
__device__ __forceinline__ Channels<kLane> plus(const Channels<kLane>& a, float t, const Channels<kLane>& b) {
  Channels<kLane> out;
#pragma unroll
  for (int i = 0; i < kLane; ++i) out.v[i] = a.v[i] + t * b.v[i];
  return out;
}

template <int kLane>
__device__ __forceinline__ Channels<kLane> between(const Channels<kLane>& a, const Channels<kLane>& b, float t) {
  return plus(a, t, b - a);
}

// Grid nodes around a point: four in a plane, two in a line. Offsets are integers that count floats.
struct Corners {
  int64_t start;         // offset of the first node from the start of the plane
  int32_t right, below;  // offsets from the first node to its neighbours; 0 if the axis has only one node
  LinePosition u, v;

  __device__ Corners(const FeaturePlane& plane, const LinePosition& along_u, const LinePosition& along_v, int channels)
      : right(plane.width > 1 ? channels : 0), below(plane.height > 1 ? plane.width * channels : 0), u(along_u), v(along_v) {
    start = (int64_t(int32_t(v.cell)) * plane.width + int32_t(u.cell)) * channels;
  }
  __device__ Corners(const FeaturePlane& plane, float at_u, float at_v, int channels)
      : Corners(plane, position_on(at_u, plane.width), position_on(at_v, plane.height), channels) {}
};

template <int kLane>
struct Sample {
  Channels<kLane> p00, p10, p01, p11;

  __device__ Sample(const float* plane, const Corners& at, int channel) {
    const float* p = plane + at.start + channel;
    p00 = Channels<kLane>::load(p), p10 = Channels<kLane>::load(p + at.right);
    p01 = Channels<kLane>::load(p + at.below), p11 = Channels<kLane>::load(p + at.below + at.right);
  }
  __device__ Channels<kLane> value(const Corners& at) const {
    return between(between(p00, p10, at.u.fraction), between(p01, p11, at.u.fraction), at.v.fraction);
  }
  __device__ Channels<kLane> along_u(const Corners& at) const { return between(p10 - p00, p11 - p01, at.v.fraction); }
  __device__ Channels<kLane> along_v(const Corners& at) const { return between(p01 - p00, p11 - p10, at.u.fraction); }
  // Compute the interpolated value and its derivatives along u and v together; they share most of the computation.
  __device__ void value_and_slopes(const Corners& at, Channels<kLane>& value, Channels<kLane>& along_u,
                                   Channels<kLane>& along_v) const {
    const Channels<kLane> upper = p10 - p00, lower = p11 - p01, top = plus(p00, at.u.fraction, upper);
    along_u = between(upper, lower, at.v.fraction);
    along_v = plus(p01, at.u.fraction, lower) - top;
    value = plus(top, at.v.fraction, along_v);
  }
};

// Sum over the lanes of a team, in a fixed order, returned to every lane.
template <int kTeam>
__device__ __forceinline__ float team_sum(float x) {
#pragma unroll
  for (int apart = kTeam / 2; apart > 0; apart /= 2) x += __shfl_xor_sync(0xffffffffu, x, apart);
  return x;
}

// Call `run` with the channels per lane and the lanes per team as constants. Every row of channels must be aligned to
// 16 bytes.
template <class Run>
void with_wide_team(int64_t channels, const Run& run) {
  const auto four = std::integral_constant<int, 4>();
  if (channels <= 32) return run(four, std::integral_constant<int, 8>());
  run(four, std::integral_constant<int, 16>());
}

// Call `run` with the channels per lane and the lanes per team as constants, for any alignment: 4 channels per lane
// only if `wide`.
template <class Run>
void with_team(bool wide, int64_t channels, const Run& run) {
  if (wide) return with_wide_team(channels, run);
  run(std::integral_constant<int, 1>(), std::integral_constant<int, 16>());
}

constexpr int kDenseCell = 8;  // a cell with at least this many Gaussians is dense: a separate pass sums its rows
constexpr int kDenseRun = 32;  // sorted rows per team in that pass
constexpr int kNodeBatch = 2;  // rows of a node in flight; few, because many nodes are processed concurrently

// One plane's Gaussians sorted by cell = major coordinate * minor size + minor coordinate.
struct SortedCells {
  const int32_t* starts;    // start of each cell's items, from the plane's first cell
  const float* rows;        // [items of all planes, C], sorted: gradient of the plane's sample
  const float* fractions;   // [items, 2]: fractional position between nodes along the major and the minor axis
  const float* dense_sums;  // sums of dense cells for their corners (../hexplane_training/training.h), or null
  int32_t minor_size;
};

// Weight of node `node` in a sample at `at`.
__device__ __forceinline__ float weight_of(const LinePosition& at, int node) {
  return int(at.cell) == node ? 1.0f - at.fraction : int(at.cell) == node - 1 ? at.fraction : 0.0f;
}

// Call use(i, fraction along major, along minor, row) for the sorted items [begin, end) in order, loading kBatch of
// them at once.
template <int kLane, int kBatch, class Use>
__device__ __forceinline__ void for_rows(const SortedCells& cells, int32_t begin, int32_t end, int channel, int channels,
                                         const Use& use) {
  for (int32_t i = begin; i < end; i += kBatch) {
    Channels<kLane> row[kBatch];
    float2 share[kBatch];
#pragma unroll
    for (int k = 0; k < kBatch; ++k) {
      const int64_t at = min(i + k, end - 1);
      row[k] = Channels<kLane>::load(cells.rows + at * channels + channel);
      share[k] = *reinterpret_cast<const float2*>(cells.fractions + 2 * at);
    }
#pragma unroll
    for (int k = 0; k < kBatch; ++k)
      if (i + k < end) use(i + k, share[k].x, share[k].y, row[k]);
  }
}

// Index in [runs, 5, 4, C] of the sums of a dense cell's rows in run `run`. The first of the five slots is for the cell
// that begins in an earlier run. The other four are for cells that begin in each quarter of the run; at most one dense
// cell begins in a quarter.
__device__ __forceinline__ int64_t dense_place(int run, bool begins, int32_t begin, int corner) {
  return (int64_t(run) * 5 + (begins ? 1 + begin % kDenseRun / kDenseCell : 0)) * 4 + corner;
}

template <int kLane>
__device__ Channels<kLane> node_gradient(const SortedCells& cells, int major, int minor, int channel, int channels) {
  Channels<kLane> sum = Channels<kLane>::all(0.0f);
#pragma unroll 1
  for (int left = 0; left < 2; ++left) {  // along the major axis, process the cell on the node's right last
    const int cell_major = major - 1 + left;
    if (cell_major < 0) continue;
    const int32_t* starts = cells.starts + int64_t(cell_major) * cells.minor_size + minor;
    const int32_t bounds[3] = {starts[minor > 0 ? -1 : 0], starts[0], starts[1]};
    if (bounds[0] == bounds[2]) continue;
#pragma unroll
    for (int low = 0; low < 2; ++low) {
      const int32_t begin = bounds[low], end = bounds[low + 1];
      if (cells.dense_sums != nullptr && end - begin >= kDenseCell) {
        const int first = begin / kDenseRun, corner = 2 * (1 - left) + (1 - low);
        for (int run = first; run <= (end - 1) / kDenseRun; ++run)
          sum =
              plus(sum, 1.0f,
                   Channels<kLane>::load(cells.dense_sums + dense_place(run, run == first, begin, corner) * channels + channel));
        continue;
      }
      for_rows<kLane, kNodeBatch>(cells, begin, end, channel, channels,
                                  [&](int32_t, float along, float across, const Channels<kLane>& row) {
                                    sum = plus(sum, (left ? 1.0f - along : along) * (low ? 1.0f - across : across), row);
                                  });
    }
  }
  return sum;
}

}  // namespace gsplat::hexplane
