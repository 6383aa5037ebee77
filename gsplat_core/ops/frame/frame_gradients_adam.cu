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

// To two units in the last place, which is far below what Adam's epsilon and rates leave of a step's precision.
__device__ inline float square_root(float x) {
  float y;
  asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ inline void update(float& p, float g, float& m, float& v, float rate, const AdamFactors& f) {
  m = fmaf(f.fresh1, g - m, m);
  v = fmaf(f.fresh2, fmaf(g, g, -v), v);
  p -= __fdividef(rate * m, fmaf(square_root(v), f.inv_bias2, f.epsilon));
}

// One tensor's share of the warp: gradient(value of the share); rows with a bit in `poisoned` stay as they are.
template <int kColumns, class Gradient>
__device__ inline void update_rows(const FrameAdam& adam, int tensor, int64_t first, int rows, unsigned poisoned,
                                   const AdamFactors& factors, int lane, const Gradient& gradient) {
  const int64_t at = first * kColumns;
  float *const p = adam.parameters[tensor] + at, *const m = adam.first[tensor] + at, *const v = adam.second[tensor] + at;
  const float rate = factors.rates[tensor];
  const auto single = [&](int i) {
    if ((poisoned >> (i / kColumns) & 1) == 0) update(p[i], gradient(i), m[i], v[i], rate, factors);
  };
  const auto quad = [&](int i) {
    float4 &parameter = reinterpret_cast<float4*>(p)[i], &mean = reinterpret_cast<float4*>(m)[i],
           &square = reinterpret_cast<float4*>(v)[i];
    float4 new_parameter = parameter, new_mean = mean, new_square = square;
    update(new_parameter.x, gradient(4 * i), new_mean.x, new_square.x, rate, factors);
    update(new_parameter.y, gradient(4 * i + 1), new_mean.y, new_square.y, rate, factors);
    update(new_parameter.z, gradient(4 * i + 2), new_mean.z, new_square.z, rate, factors);
    update(new_parameter.w, gradient(4 * i + 3), new_mean.w, new_square.w, rate, factors);
    parameter = new_parameter, mean = new_mean, square = new_square;
  };
  if (poisoned == 0) {
    each_value<kColumns>(rows, lane, quad, single);
    return;
  }
  for (int i = lane; i < rows * kColumns; i += 32) single(i);
  if (lane == 0) atomicAdd(adam.skipped + tensor, (unsigned long long)(__popc(poisoned)));
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
__global__ void __launch_bounds__(kSplatThreads<kDegree>, kDegree < 4 ? 5 : 1)
    update_splats(FrameScene scene, FrameLists lists, FrameGradients from, RawGradients to, FrameAdam adam) {
  __shared__ WarpGradients<kDegree> warps[kSplatThreads<kDegree> / 32];
  __shared__ FrameCamera camera;
  load_camera(scene, camera);
  const int lane = threadIdx.x & 31;
  const int64_t first = int64_t(blockIdx.x) * kSplatThreads<kDegree> + threadIdx.x / 32 * 32;
  if (first >= scene.count) return;
  const int count = int(scene.count - first < 32 ? scene.count - first : 32);
  WarpGradients<kDegree>& warp = warps[threadIdx.x / 32];
  constexpr int columns[] = {3, 4, 3, 1, warp.kHarmonics};
  for (int i = 0; i < kRateCount; ++i) {
    prefetch(adam.first[i] + first * columns[i], count * columns[i], lane);
    prefetch(adam.second[i] + first * columns[i], count * columns[i], lane);
  }
  warp.compute(scene, camera, lists, from, first, count, lane);

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
    constexpr int kDegree = decltype(degree)::value, kBlock = kSplatThreads<kDegree>;
    update_splats<kDegree><<<blocks_for(scene.count, kBlock), kBlock, 0, stream>>>(scene, lists, from, to, adam);
  });
}
