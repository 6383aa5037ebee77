#include "basis_field_warp.cuh"

namespace gsplat::basis_field {
namespace {

constexpr int kFlight = 5;  // row pairs in flight per warp, of parameters and of both moments

struct Update {
  float parameter, first, second;
};

// Approximate functions with errors of 1 and 2 ulp, which is sufficient for Adam.
__device__ __forceinline__ float root(float x) {
  float y;
  asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ __forceinline__ float reciprocal(float x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

// One Adam update; `rate` is the learning rate / (1 - beta1^k), `inverse_root_bias2` 1 / sqrt(1 - beta2^k).
__device__ __forceinline__ Update adam_update(Update old, float g, float rate, float inverse_root_bias2,
                                              const DeviceBasisAdam& a) {
  const float m = old.first + a.fresh1 * (g - old.first), v = old.second + a.fresh2 * (g * g - old.second);
  return {old.parameter - rate * m * reciprocal(root(v) * inverse_root_bias2 + a.epsilon), m, v};
}

// Update a lane's own bump parameter, a centre or a log-width, in memory with `adam_update`.
__device__ __forceinline__ void update_own(float* p, float* m, float* v, int64_t own, const Update& old, float g, float rate,
                                           float inverse_root_bias2, const DeviceBasisAdam& a) {
  const Update now = adam_update(old, g, rate, inverse_root_bias2, a);
  p[own] = now.parameter;
  m[own] = now.first;
  v[own] = now.second;
}

// 1 - beta^k; -expm1 keeps it accurate for a beta near 1 and few updates.
__device__ __forceinline__ float bias(float log_beta, int updates) { return -expm1f(float(updates) * log_beta); }

__global__ void __launch_bounds__(kBlock, 4) adam(DeviceBasisAdam field, const float* __restrict__ gradient) {
  const Place at;
  if (at.gaussian >= field.count) return;
  // Issue all independent loads first.
  const float g = at.has_channel ? gradient[at.gaussian * field.row + at.channel] : 0.0f;
  const int64_t first = at.gaussian * field.bumps;
  Timing next = timing_at(field.centers, field.log_widths, first, at.lane, field.bumps);
  const float tau = *field.tau, channel_rate = field.rates[basis_rate_of(at.channel)];
  // Skip Gaussians that are not visible in the frame or have a non-finite gradient.
  if (!__any_sync(kAll, g != 0.0f) || __any_sync(kAll, !isfinite(g * g))) return;
  for (int from = 0; from < field.bumps; from += 32) {
    const bool exists = from + at.lane < field.bumps;
    const int64_t own = first + from + at.lane;
    Update own_center = {next.center, 0, 0}, own_width = {next.log_width, 0, 0};
    const Bump b = bump_at(next.center, next.log_width, tau, exists);
    if (from + 32 < field.bumps) next = timing_at(field.centers, field.log_widths, first, from + 32 + at.lane, field.bumps);
    const unsigned active = __ballot_sync(kAll, b.active);
    if (active == 0) continue;
    const Span span = span_of(active);
    int updates = 1;
    float bias1 = 1, bias2 = 1;  // 1 / (1 - beta1^k), 1 / sqrt(1 - beta2^k)
    float along = 0;             // g . w before the update
    for (int pair = span.first; pair <= span.last; pair += 2 * kFlight) {
      const int64_t place = (first + from + pair + at.half) * kBasisChannels + at.channel;
      float *weights = field.weights + place, *firsts = field.m_weights + place, *seconds = field.v_weights + place;
      Update old[kFlight];
#pragma unroll
      for (int i = 0; i < kFlight; ++i) {
        const int bump = pair + 2 * i + at.half;
        const bool reads = bump <= span.last && is_set(active, bump) && at.has_channel;
        old[i].parameter = reads ? weights[2 * i * kBasisChannels] : 0.0f;
        old[i].first = reads ? firsts[2 * i * kBasisChannels] : 0.0f;
        old[i].second = reads ? seconds[2 * i * kBasisChannels] : 0.0f;
      }
      if (pair == span.first && b.active) {  // loaded together with the rows
        updates = field.steps[own] + 1;
        own_center.first = field.m_centers[own], own_center.second = field.v_centers[own];
        own_width.first = field.m_log_widths[own], own_width.second = field.v_log_widths[own];
        bias1 = reciprocal(bias(field.log_beta1, updates));
        bias2 = reciprocal(root(bias(field.log_beta2, updates)));
      }
#pragma unroll
      for (int i = 0; i < kFlight; ++i) {
        const int bump = pair + 2 * i + at.half;
        if (pair + 2 * i > span.last) break;  // uniform over the warp
        const float dot = sum_of_half(g * old[i].parameter);
        const float height = __shfl_sync(kAll, b.height, bump & 31);
        const float by1 = __shfl_sync(kAll, bias1, bump & 31), by2 = __shfl_sync(kAll, bias2, bump & 31);
        const float of_own = __shfl_sync(kAll, dot, (at.lane - pair) & 1 ? 16 : 0);
        if ((at.lane - pair) >> 1 == i) along = of_own;
        if (bump <= span.last && is_set(active, bump) && at.has_channel) {
          const Update now = adam_update(old[i], height * g, channel_rate * by1, by2, field);
          weights[2 * i * kBasisChannels] = now.parameter;
          firsts[2 * i * kBasisChannels] = now.first;
          seconds[2 * i * kBasisChannels] = now.second;
        }
        __syncwarp();
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

}  // namespace gsplat::basis_field
