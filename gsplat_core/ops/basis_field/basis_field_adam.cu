#include "basis_field_warp.cuh"

namespace {

using namespace basis_warp;

constexpr int kFlight = 3;  // pairs of rows that a warp reads at once, of parameters and of both moments

struct Update {
  float parameter, first, second;
};

// One Adam update; `rate` is the learning rate / (1 - beta1^k), `inverse_root_bias2` 1 / sqrt(1 - beta2^k).
__device__ __forceinline__ Update adam_update(Update old, float g, float rate, float inverse_root_bias2,
                                              const DeviceBasisAdam& a) {
  const float m = old.first + a.fresh1 * (g - old.first), v = old.second + a.fresh2 * (g * g - old.second);
  return {old.parameter - rate * m / (sqrtf(v) * inverse_root_bias2 + a.epsilon), m, v};
}

// The same for a lane's own bump: a centre or a log-width.
__device__ __forceinline__ void update_own(float* p, float* m, float* v, int64_t own, const Update& old, float g, float rate,
                                           float inverse_root_bias2, const DeviceBasisAdam& a) {
  const Update now = adam_update(old, g, rate, inverse_root_bias2, a);
  p[own] = now.parameter;
  m[own] = now.first;
  v[own] = now.second;
}

// -expm1 keeps 1 - beta^k accurate for a beta near 1 and few updates.
__device__ __forceinline__ float bias(float log_beta, int updates) { return -expm1f(float(updates) * log_beta); }

__global__ void __launch_bounds__(kBlock) adam(DeviceBasisAdam field, const float* __restrict__ gradient) {
  const Place at;
  if (at.gaussian >= field.count) return;
  const float g = at.has_channel ? gradient[at.gaussian * field.row + at.channel] : 0.0f;
  // The frame does not show this Gaussian, or says nothing of use about it.
  if (!__any_sync(kAll, g != 0.0f) || __any_sync(kAll, !isfinite(g * g))) return;
  const float tau = *field.tau;
  const float channel_rate = field.rates[basis_rate_of(at.channel)];
  const int64_t first = at.gaussian * field.bumps;
  for (int64_t from = 0; from < field.bumps; from += 32) {
    const bool exists = from + at.lane < field.bumps;
    const int64_t own = first + from + (exists ? at.lane : 0);
    const float center = field.centers[own], log_width = field.log_widths[own];
    const Bump b = bump_at(center, log_width, tau, exists);
    unsigned left = __ballot_sync(kAll, b.active);
    if (left == 0) continue;
    int updates = 1;
    Update own_center = {center, 0, 0}, own_width = {log_width, 0, 0};
    if (b.active) {  // asked for now, so that they come with the rows
      updates = field.steps[own] + 1;
      own_center.first = field.m_centers[own], own_center.second = field.v_centers[own];
      own_width.first = field.m_log_widths[own], own_width.second = field.v_log_widths[own];
    }
    const int64_t rows = (first + from) * kBasisChannels + at.channel;
    const float bias1 = 1.0f / bias(field.log_beta1, updates), bias2 = 1.0f / sqrtf(bias(field.log_beta2, updates));
    float along = 0;  // g . w before the update
    while (left != 0) {
      Update old[kFlight];
      int row[kFlight];
#pragma unroll
      for (int i = 0; i < kFlight; ++i) {
        row[i] = left != 0 ? next_row(left, at.half) : -1;
        const int64_t place = rows + row[i] * kBasisChannels;
        const bool reads = row[i] >= 0 && at.has_channel;
        old[i].parameter = reads ? field.weights[place] : 0.0f;
        old[i].first = reads ? field.m_weights[place] : 0.0f;
        old[i].second = reads ? field.v_weights[place] : 0.0f;
      }
#pragma unroll
      for (int i = 0; i < kFlight; ++i) {
        const int source = row[i] & 31;
        const float dot = sum_of_half(g * old[i].parameter);
        const float height = __shfl_sync(kAll, b.height, source);
        const float by1 = __shfl_sync(kAll, bias1, source), by2 = __shfl_sync(kAll, bias2, source);
        const float of_first = __shfl_sync(kAll, dot, 0), of_second = __shfl_sync(kAll, dot, 16);
        const int row_first = __shfl_sync(kAll, row[i], 0), row_second = __shfl_sync(kAll, row[i], 16);
        if (at.lane == row_first) along = of_first;
        if (at.lane == row_second) along = of_second;
        if (row[i] < 0 || !at.has_channel) continue;
        const Update now = adam_update(old[i], height * g, channel_rate * by1, by2, field);
        const int64_t place = rows + row[i] * kBasisChannels;
        field.weights[place] = now.parameter;
        field.m_weights[place] = now.first;
        field.v_weights[place] = now.second;
      }
    }
    if (!b.active) continue;
    field.steps[own] = updates;
    const float slope = b.height * 2.0f * b.u * along;
    update_own(field.centers, field.m_centers, field.v_centers, own, own_center, slope * b.inverse_width,
               field.rates[kBasisCenterRate] * bias1, bias2, field);
    update_own(field.log_widths, field.m_log_widths, field.v_log_widths, own, own_width, slope * b.u,
               field.rates[kBasisWidthRate] * bias1, bias2, field);
  }
}

}  // namespace

void basis_field_adam_on_device(const DeviceBasisAdam& field, const float* gradient, cudaStream_t stream) {
  if (field.count == 0) return;
  adam<<<unsigned((field.count + kWarps - 1) / kWarps), kBlock, 0, stream>>>(field, gradient);
}
