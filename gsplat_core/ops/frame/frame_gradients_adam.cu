// As frame_gradients_splats.cu, with Adam over the Gaussians at its end: their gradient never goes through memory.
#include <type_traits>

#include "frame_gradients_warp.cuh"

namespace {

// What Adam multiplies by in this step; see ops/adam/adam.h.
struct AdamFactors {
  float rates[kRateCount], inv_bias2, fresh1, fresh2, epsilon;
};

// beta^step by squaring: the step is in device memory, and a general power in double would take the threads longer than the rest.
__device__ inline double power_of(double base, int64_t exponent) {
  double result = 1;
  for (; exponent > 0; exponent /= 2, base *= base)
    if (exponent % 2 != 0) result *= base;
  return result;
}

// Even lanes compute the first moment's share, odd ones the second's.
__device__ inline AdamFactors factors_of(const FrameAdam& adam, int lane) {
  const int64_t step = adam.step_is_long ? *static_cast<const int64_t*>(adam.step) : *static_cast<const int32_t*>(adam.step);
  const double bias = 1 - power_of(lane % 2 == 0 ? adam.beta1 : adam.beta2, step);
  const double mine = lane % 2 == 0 ? 1 / bias : ::rsqrt(bias);
  const double over_bias1 = __shfl_sync(kAllLanes, mine, 0);
  AdamFactors f = {};
  for (int i = 0; i < kRateCount; ++i) f.rates[i] = float(adam.rates[i] * over_bias1);
  f.inv_bias2 = float(__shfl_sync(kAllLanes, mine, 1));
  f.fresh1 = float(1 - adam.beta1);
  f.fresh2 = float(1 - adam.beta2);
  f.epsilon = adam.epsilon;
  return f;
}

__device__ inline void update(float& p, float g, float& m, float& v, float rate, const AdamFactors& f) {
  m += f.fresh1 * (g - m);
  v += f.fresh2 * (g * g - v);
  p -= rate * m / (sqrtf(v) * f.inv_bias2 + f.epsilon);
}

// One tensor's share of the warp: gradient(value of the share); rows with a bit in `poisoned` stay as they are.
template <int kColumns, class Gradient>
__device__ inline void update_rows(const FrameAdam& adam, int tensor, int64_t first, int rows, unsigned poisoned,
                                   const AdamFactors& factors, int lane, const Gradient& gradient) {
  const int64_t at = first * kColumns;
  float *const p = adam.parameters[tensor] + at, *const m = adam.first[tensor] + at, *const v = adam.second[tensor] + at;
  const float rate = factors.rates[tensor];
  const auto usable = [&](int value) { return (poisoned >> (value / kColumns) & 1) == 0; };
  each_value<kColumns>(
      rows, lane,
      [&](int i) {
        float4 parameter = reinterpret_cast<float4*>(p)[i], mean = reinterpret_cast<float4*>(m)[i],
               square = reinterpret_cast<float4*>(v)[i];
        if (usable(4 * i)) update(parameter.x, gradient(4 * i), mean.x, square.x, rate, factors);
        if (usable(4 * i + 1)) update(parameter.y, gradient(4 * i + 1), mean.y, square.y, rate, factors);
        if (usable(4 * i + 2)) update(parameter.z, gradient(4 * i + 2), mean.z, square.z, rate, factors);
        if (usable(4 * i + 3)) update(parameter.w, gradient(4 * i + 3), mean.w, square.w, rate, factors);
        reinterpret_cast<float4*>(p)[i] = parameter;
        reinterpret_cast<float4*>(m)[i] = mean;
        reinterpret_cast<float4*>(v)[i] = square;
      },
      [&](int i) {
        if (usable(i)) update(p[i], gradient(i), m[i], v[i], rate, factors);
      });
  if (lane == 0 && poisoned != 0) atomicAdd(adam.skipped + tensor, (unsigned long long)(__popc(poisoned)));
}

// Whether Adam can use these gradients: their squares too are finite.
template <int kCount>
__device__ inline bool usable_gradient(const float* v) {
  bool usable = true;
#pragma unroll
  for (int i = 0; i < kCount; ++i) usable &= isfinite(v[i] * v[i]);
  return usable;
}

template <int kDegree>
__global__ void __launch_bounds__(kSplatThreads)
    update_splats(FrameScene scene, FrameLists lists, const float4* rows, RawGradients to, FrameAdam adam) {
  __shared__ WarpGradients<kDegree> warps[kSplatWarps];
  const int lane = threadIdx.x & 31;
  const int64_t first = int64_t(blockIdx.x) * kSplatThreads + threadIdx.x / 32 * 32;
  if (first >= scene.count) return;
  const int count = int(scene.count - first < 32 ? scene.count - first : 32);
  WarpGradients<kDegree>& warp = warps[threadIdx.x / 32];
  warp.compute(scene, lists, rows, first, count, lane);

  float raw[kRawColumns], sh[warp.kHarmonics];
  warp.raw.get(lane, raw);
  warp.sh.get(lane, sh);
  const bool mine = lane < count;
  const unsigned poisoned[kRateCount] = {__ballot_sync(kAllLanes, mine && !usable_gradient<3>(raw)),
                                         __ballot_sync(kAllLanes, mine && !usable_gradient<4>(raw + 3)),
                                         __ballot_sync(kAllLanes, mine && !usable_gradient<3>(raw + 7)),
                                         __ballot_sync(kAllLanes, mine && !usable_gradient<1>(raw + 13)),
                                         __ballot_sync(kAllLanes, mine && !usable_gradient<warp.kHarmonics>(sh))};
  __syncwarp();
  if (lists.status[kStatusCut] == 0) {
    const AdamFactors factors = factors_of(adam, lane);
    const auto column = [&](int columns, int offset) {
      return [&warp, columns, offset](int i) { return warp.raw.values[i / columns * warp.raw.kStride + offset + i % columns]; };
    };
    update_rows<3>(adam, 0, first, count, poisoned[0], factors, lane, column(3, 0));
    update_rows<4>(adam, 1, first, count, poisoned[1], factors, lane, column(4, 3));
    update_rows<3>(adam, 2, first, count, poisoned[2], factors, lane, column(3, 7));
    update_rows<1>(adam, 3, first, count, poisoned[3], factors, lane, column(1, 13));
    update_rows<warp.kHarmonics>(adam, 4, first, count, poisoned[4], factors, lane,
                                 [&](int i) { return warp.sh.values[warp.sh.place(i)]; });
  }
  // A field learns nothing from a Gaussian whose gradient is not usable.
  __syncwarp();
  if (mine && !usable_gradient<kRawGradients>(raw)) {
    const float none[kRawColumns] = {};
    warp.raw.put(lane, none);
  }
  __syncwarp();
  if (to.raw != nullptr) write_rows(warp.raw, to.raw + first * kRawColumns, count, lane);
}

}  // namespace

void splat_gradients_adam_on_device(const FrameScene& scene, const FrameLists& lists, const FrameGradients& from,
                                    const RawGradients& to, const FrameAdam& adam, cudaStream_t stream) {
  if (scene.count == 0) return;
  with_degree(scene.bases, [&](auto degree) {
    update_splats<decltype(degree)::value>
        <<<blocks_for(scene.count, kSplatThreads), kSplatThreads, 0, stream>>>(scene, lists, from.rows, to, adam);
  });
}
