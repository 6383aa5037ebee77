#include "basis_field_warp.cuh"

namespace {

using namespace basis_warp;

constexpr int kFlight = 5;  // pairs of rows that a warp reads at once: bumps of width 1, one per spacing, have 8 or 9 active

__global__ void __launch_bounds__(kBlock) forward(DeviceBumps field, float* __restrict__ deltas) {
  const Place at;
  if (at.gaussian >= field.count) return;
  const float tau = *field.tau;
  const int64_t first = at.gaussian * field.bumps;
  float total = 0;
  for (int64_t from = 0; from < field.bumps; from += 32) {
    const bool exists = from + at.lane < field.bumps;
    const int64_t own = first + from + (exists ? at.lane : 0);
    const Bump b = bump_at(field.centers[own], field.log_widths[own], tau, exists);
    const float* weights = field.weights + (first + from) * kBasisChannels + at.channel;
    for (unsigned left = __ballot_sync(kAll, b.active); left != 0;) {
      float w[kFlight], height[kFlight];
#pragma unroll
      for (int i = 0; i < kFlight; ++i) {
        const int row = left != 0 ? next_row(left, at.half) : -1;
        const bool reads = row >= 0 && at.has_channel;
        w[i] = reads ? weights[row * kBasisChannels] : 0.0f;
        const float h = __shfl_sync(kAll, b.height, row & 31);
        height[i] = reads ? h : 0.0f;
      }
#pragma unroll
      for (int i = 0; i < kFlight; ++i) total += height[i] * w[i];
    }
  }
  total += __shfl_xor_sync(kAll, total, 16);
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

}  // namespace

void basis_field_on_device(const DeviceBumps& field, float* deltas, cudaStream_t stream) {
  if (field.count == 0) return;
  forward<<<unsigned((field.count + kWarps - 1) / kWarps), kBlock, 0, stream>>>(field, deltas);
}

void basis_field_backward_on_device(const DeviceBumps& field, const float* gradient, float* centers, float* log_widths,
                                    float* weights, cudaStream_t stream) {
  if (field.count == 0) return;
  backward<<<unsigned((field.count + kWarps - 1) / kWarps), kBlock, 0, stream>>>(field, gradient, centers, log_widths, weights);
}
