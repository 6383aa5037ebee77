// Bilinear samples of channels-last planes: a team of lanes has a point, and each lane some of its channels.
#pragma once

#include "hexplane.h"
#include "line_position.h"

namespace hexplane {

using GSPLAT_ISA::LinePosition;
using GSPLAT_ISA::position_on;

// kPlaneAxes for device code, which cannot index it.
constexpr int u_axis(int plane) { return plane == 2 || plane == 4 ? 1 : plane == 5 ? 2 : 0; }
constexpr int v_axis(int plane) { return plane == 0 ? 1 : plane < 3 ? 2 : 3; }

// Neighbouring channels of a lane: 4 where the channels are a multiple of 4 and memory is aligned, otherwise 1.
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

// The cells around a point: of a plane four, of a line two. Offsets are in floats, from the start of the plane.
struct Corners {
  int64_t start;
  int32_t right, below;  // to the neighbours; 0 where there is one cell only
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
  // All three, which share most of their work: the value, and its derivatives per cell.
  __device__ void value_and_slopes(const Corners& at, Channels<kLane>& value, Channels<kLane>& along_u,
                                   Channels<kLane>& along_v) const {
    const Channels<kLane> upper = p10 - p00, lower = p11 - p01, top = plus(p00, at.u.fraction, upper);
    along_u = between(upper, lower, at.v.fraction);
    along_v = plus(p01, at.u.fraction, lower) - top;
    value = plus(top, at.v.fraction, along_v);
  }
};

// The sum over the lanes of a team, in a fixed order; every lane has it.
template <int kTeam>
__device__ __forceinline__ float team_sum(float x) {
#pragma unroll
  for (int apart = kTeam / 2; apart > 0; apart /= 2) x += __shfl_xor_sync(0xffffffffu, x, apart);
  return x;
}

}  // namespace hexplane
