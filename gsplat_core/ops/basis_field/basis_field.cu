#include "basis_field_warp.cuh"

namespace gsplat::basis_field {
namespace {

constexpr int kFlight = 5;  // row pairs in flight per warp; bumps of width 1, spaced by 1, have 8 or 9 active rows

// Return the lane's channel of the sum over the Gaussian's bumps; both halves of the warp receive it.
__device__ __forceinline__ float delta_of(const DeviceBumps& field, const Place& at, float tau) {
  const int64_t first = at.gaussian * field.bumps;
  Timing next = timing_at(field.centers, field.log_widths, first, at.lane, field.bumps);
  float total = 0;
  for (int from = 0; from < field.bumps; from += 32) {
    const Bump b = bump_at(next.center, next.log_width, tau, from + at.lane < field.bumps);
    if (from + 32 < field.bumps) next = timing_at(field.centers, field.log_widths, first, from + 32 + at.lane, field.bumps);
    const unsigned active = __ballot_sync(kAll, b.active);
    if (active == 0) continue;
    const Span span = span_of(active);
    for (int pair = span.first; pair <= span.last; pair += 2 * kFlight) {
      const float* row = field.weights + (first + from + pair + at.half) * kBasisChannels + at.channel;
      float w[kFlight];
#pragma unroll
      for (int i = 0; i < kFlight; ++i) {
        const int bump = pair + 2 * i + at.half;
        w[i] = bump <= span.last && is_set(active, bump) && at.has_channel ? row[2 * i * kBasisChannels] : 0.0f;
      }
#pragma unroll
      for (int i = 0; i < kFlight; ++i) {
        if (pair + 2 * i > span.last) break;
        const int bump = pair + 2 * i + at.half;
        const float height = __shfl_sync(kAll, b.height, bump & 31);
        if (bump <= span.last && at.has_channel) total += height * w[i];
      }
    }
  }
  return total + __shfl_xor_sync(kAll, total, 16);
}

__global__ void __launch_bounds__(kBlock) forward(DeviceBumps field, float* __restrict__ deltas) {
  const Place at;
  if (at.gaussian >= field.count) return;
  const float total = delta_of(field, at, *field.tau);
  if (at.half == 0 && at.channel < field.row) deltas[at.gaussian * field.row + at.channel] = at.has_channel ? total : 0.0f;
}

__global__ void __launch_bounds__(kBlock)
    backward(DeviceBumps field, const float* __restrict__ gradient, float* __restrict__ v_centers,
             float* __restrict__ v_log_widths, float* __restrict__ v_weights) {
  const Place at;
  if (at.gaussian >= field.count) return;
  const float tau = *field.tau;
  const float g = at.has_channel ? gradient[at.gaussian * field.row + at.channel] : 0.0f;
  const int64_t first = at.gaussian * field.bumps;
  for (int64_t from = 0; from < field.bumps; from += 32) {
    const int64_t left = field.bumps - from;
    const int count = left < 32 ? int(left) : 32;
    const bool exists = at.lane < count;
    const int64_t own = first + from + (exists ? at.lane : 0);
    const Bump b = bump_at(field.centers[own], field.log_widths[own], tau, exists);
    const unsigned mask = __ballot_sync(kAll, b.active);
    float along = 0;  // g . w
    for (int pair = 0; pair < count; pair += 2) {
      const int row = pair + at.half;
      const bool has_row = row < count && at.has_channel, active = (mask >> row) & 1u;
      const int64_t place = (first + from + row) * kBasisChannels + at.channel;
      const float dot = sum_of_half(has_row && active ? g * field.weights[place] : 0.0f);
      const float height = __shfl_sync(kAll, b.height, row & 31);
      if (has_row) v_weights[place] = active ? height * g : 0.0f;
      const float of_first = __shfl_sync(kAll, dot, 0), of_second = __shfl_sync(kAll, dot, 16);
      if (at.lane == pair) along = of_first;
      if (at.lane == pair + 1) along = of_second;
    }
    if (!exists) continue;
    const float slope = b.height * 2.0f * b.u * along;
    v_centers[own] = b.active ? slope * b.inverse_width : 0.0f;
    v_log_widths[own] = b.active ? slope * b.u : 0.0f;
  }
}

// Return the sum of the squared bump heights of the Gaussian to all lanes.
__device__ __forceinline__ float squared_heights(const DeviceBumps& field, const Place& at, float tau) {
  const int64_t first = at.gaussian * field.bumps;
  float squared = 0;
  for (int from = 0; from < field.bumps; from += 32) {
    const Timing t = timing_at(field.centers, field.log_widths, first, from + at.lane, field.bumps);
    const Bump b = bump_at(t.center, t.log_width, tau, from + at.lane < field.bumps);
    squared = fmaf(b.height, b.height, squared);
  }
  for (int offset = 16; offset > 0; offset /= 2) squared += __shfl_xor_sync(kAll, squared, offset);
  return squared;
}

// Minimum-norm change of the colour weights: proportional to the heights, divided by the sum of their squares.
__global__ void __launch_bounds__(kBlock)
    add_colours(DeviceBumps field, float* __restrict__ weights, const float* __restrict__ change) {
  const Place at;
  if (at.gaussian >= field.count) return;
  const float* const c = change + 3 * at.gaussian;
  const float red = c[0], green = c[1], blue = c[2], size = red * red + green * green + blue * blue;
  if (!(size > 0 && isfinite(size))) return;  // uniform over the warp
  const float tau = *field.tau, squared = squared_heights(field, at, tau);
  if (!(squared > kLeastSquaredHeights)) return;
  const int64_t first = at.gaussian * field.bumps;
  for (int from = 0; from < field.bumps; from += 32) {
    const Timing t = timing_at(field.centers, field.log_widths, first, from + at.lane, field.bumps);
    const Bump b = bump_at(t.center, t.log_width, tau, from + at.lane < field.bumps);
    if (!b.active) continue;
    float* const to = weights + (first + from + at.lane) * kBasisChannels + kRawColor;
    const float share = b.height / squared;
    to[0] = fmaf(share, red, to[0]);
    to[1] = fmaf(share, green, to[1]);
    to[2] = fmaf(share, blue, to[2]);
  }
}

// Minimum-norm change of all weights such that the deltas become `target` [N, 13].
__global__ void __launch_bounds__(kBlock)
    move_to(DeviceBumps field, float* __restrict__ weights, const float* __restrict__ target) {
  const Place at;
  if (at.gaussian >= field.count) return;
  const float tau = *field.tau, now = delta_of(field, at, tau);
  const float change = at.has_channel ? target[at.gaussian * kBasisChannels + at.channel] - now : 0.0f;
  if (!__all_sync(kAll, isfinite(change))) return;
  const float squared = squared_heights(field, at, tau);
  if (!(squared > kLeastSquaredHeights)) return;
  const int64_t first = at.gaussian * field.bumps;
  for (int from = 0; from < field.bumps; from += 32) {
    const Timing t = timing_at(field.centers, field.log_widths, first, from + at.lane, field.bumps);
    const Bump b = bump_at(t.center, t.log_width, tau, from + at.lane < field.bumps);
    const unsigned active = __ballot_sync(kAll, b.active);
    if (active == 0) continue;
    const Span span = span_of(active);
    for (int pair = span.first; pair <= span.last; pair += 2) {
      const int bump = pair + at.half;
      const float share = __shfl_sync(kAll, b.height, bump & 31) / squared;
      if (bump > span.last || !is_set(active, bump) || !at.has_channel) continue;
      float* const to = weights + (first + from + bump) * kBasisChannels + at.channel;
      *to = fmaf(share, change, *to);
    }
  }
}

}  // namespace

void basis_field_add_colours_on_device(const DeviceBumps& field, float* weights, const float* change, cudaStream_t stream) {
  if (field.count == 0) return;
  add_colours<<<unsigned((field.count + kWarps - 1) / kWarps), kBlock, 0, stream>>>(field, weights, change);
}

void basis_field_move_to_on_device(const DeviceBumps& field, float* weights, const float* target, cudaStream_t stream) {
  if (field.count == 0) return;
  move_to<<<unsigned((field.count + kWarps - 1) / kWarps), kBlock, 0, stream>>>(field, weights, target);
}

void basis_field_on_device(const DeviceBumps& field, float* deltas, cudaStream_t stream) {
  if (field.count == 0) return;
  forward<<<unsigned((field.count + kWarps - 1) / kWarps), kBlock, 0, stream>>>(field, deltas);
}

void basis_field_backward_on_device(const DeviceBumps& field, const float* gradient, float* centers, float* log_widths,
                                    float* weights, cudaStream_t stream) {
  if (field.count == 0) return;
  backward<<<unsigned((field.count + kWarps - 1) / kWarps), kBlock, 0, stream>>>(field, gradient, centers, log_widths, weights);
}

}  // namespace gsplat::basis_field
