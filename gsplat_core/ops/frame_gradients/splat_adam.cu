// Gradients of the Gaussians' raw parameters as in splat_gradients.cu, followed by Adam in the same kernel. The
// gradients are never stored in global memory.
#include "warp_rows.cuh"

namespace gsplat::frame {
namespace {

// Factors of the current step's Adam update, as in ../adam/adam.h.
struct AdamFactors {
  float rates[kTensors], inv_bias2, fresh1, fresh2, epsilon;
};

// base^exponent by squaring. The step is in device memory, and a general double-precision power would take longer than
// the rest of the update.
__device__ inline double power_of(double base, int64_t exponent) {
  double result = 1;
  for (; exponent > 0; exponent /= 2, base *= base)
    if (exponent % 2 != 0) result *= base;
  return result;
}

// Even lanes compute the bias correction of the first moment, odd lanes that of the second moment.
__device__ inline AdamFactors factors_of(const Adam& adam, int lane) {
  const int64_t step_value =
      adam.step_is_long ? *static_cast<const int64_t*>(adam.step) : *static_cast<const int32_t*>(adam.step);
  const int64_t step = step_value < 1 ? 1 : step_value;  // steps below 1 use the correction of step 1
  const double bias = 1 - power_of(lane % 2 == 0 ? adam.beta1 : adam.beta2, step);
  const double mine = lane % 2 == 0 ? 1 / bias : ::rsqrt(bias);
  const double over_bias1 = __shfl_sync(kAllLanes, mine, 0);
  AdamFactors f = {};
  for (int i = 0; i < kTensors; ++i) f.rates[i] = float(adam.rates[i] * over_bias1);
  f.inv_bias2 = float(__shfl_sync(kAllLanes, mine, 1));
  f.fresh1 = float(1 - adam.beta1);
  f.fresh2 = float(1 - adam.beta2);
  f.epsilon = adam.epsilon;
  return f;
}

// Square root with an error of 2 ulp, which is negligible compared to Adam's epsilon and learning rates.
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

// Four values of a tensor and of its moments. All loads of a batch precede its stores: the compiler cannot prove that
// the tensors do not overlap and would serialise them. Accesses are streaming, because the data is not reused soon.
struct AdamQuad {
  float4 p, m, v;
};
__device__ inline AdamQuad load_quad(const Adam& adam, int tensor, int64_t quad) {
  return {__ldcs(reinterpret_cast<const float4*>(adam.parameters[tensor]) + quad),
          __ldcs(reinterpret_cast<const float4*>(adam.first[tensor]) + quad),
          __ldcs(reinterpret_cast<const float4*>(adam.second[tensor]) + quad)};
}
__device__ inline void store_quad(const Adam& adam, int tensor, int64_t quad, const AdamQuad& q) {
  __stcs(reinterpret_cast<float4*>(adam.parameters[tensor]) + quad, q.p);
  __stcs(reinterpret_cast<float4*>(adam.first[tensor]) + quad, q.m);
  __stcs(reinterpret_cast<float4*>(adam.second[tensor]) + quad, q.v);
}
__device__ inline void update(AdamQuad& q, const float4& g, float rate, const AdamFactors& f) {
  update(q.p.x, g.x, q.m.x, q.v.x, rate, f);
  update(q.p.y, g.y, q.m.y, q.v.y, rate, f);
  update(q.p.z, g.z, q.m.z, q.v.z, rate, f);
  update(q.p.w, g.w, q.m.w, q.v.w, rate, f);
}
__device__ inline void update_value(const Adam& adam, int tensor, int64_t at, float g, const AdamFactors& f) {
  update(adam.parameters[tensor][at], g, adam.first[tensor][at], adam.second[tensor][at], f.rates[tensor], f);
}

// Number of tensors except the last (sh), and their columns in a raw row.
constexpr int kSmall = kTensors - 1;
constexpr int small_columns(int tensor) { return tensor == 1 ? 4 : tensor == 3 ? 1 : 3; }
constexpr int small_offset(int tensor) {
  return tensor == 0 ? kRawPosition : tensor == 1 ? kRawRotation : tensor == 2 ? kRawLogScale : kRawOpacity;
}
template <int kDegree>
__device__ inline float small_gradient(const WarpGradients<kDegree>& warp, int tensor, int value) {
  const int columns = small_columns(tensor);
  return warp.raw.values[value / columns * warp.raw.kStride + small_offset(tensor) + value % columns];
}

// Update `count` Gaussians from `first` on, all of whose gradients are usable.
template <int kDegree>
__device__ inline void update_all(const Adam& adam, WarpGradients<kDegree>& warp, int64_t first, int count,
                                  const AdamFactors& factors, int lane) {
  AdamQuad small[kSmall];
#pragma unroll
  for (int t = 0; t < kSmall; ++t)
    if (lane < count * small_columns(t) / 4) small[t] = load_quad(adam, t, first / 4 * small_columns(t) + lane);
#pragma unroll
  for (int t = 0; t < kSmall; ++t) {
    const int values = count * small_columns(t), quads = values / 4;
    const auto gradient = [&](int i) { return small_gradient(warp, t, i); };
    if (lane < quads) {
      const float4 g = make_float4(gradient(4 * lane), gradient(4 * lane + 1), gradient(4 * lane + 2), gradient(4 * lane + 3));
      update(small[t], g, factors.rates[t], factors);
      store_quad(adam, t, first / 4 * small_columns(t) + lane, small[t]);
    }
    const int left = 4 * quads + lane;
    if (left < values) update_value(adam, t, first * small_columns(t) + left, gradient(left), factors);
  }
  constexpr int kBatch = 4;
  const int values = count * warp.kHarmonics, quads = values / 4;
  const int64_t at = first / 4 * warp.kHarmonics;
  for (int base = lane; base < quads; base += 32 * kBatch) {
    AdamQuad batch[kBatch];
#pragma unroll
    for (int k = 0; k < kBatch; ++k)
      if (base + 32 * k < quads) batch[k] = load_quad(adam, kSmall, at + base + 32 * k);
#pragma unroll
    for (int k = 0; k < kBatch; ++k) {
      if (base + 32 * k >= quads) continue;
      update(batch[k], warp.sh.quad(base + 32 * k), factors.rates[kSmall], factors);
      store_quad(adam, kSmall, at + base + 32 * k, batch[k]);
    }
  }
  const int left = 4 * quads + lane;
  if (left < values) update_value(adam, kSmall, first * warp.kHarmonics + left, warp.sh.values[warp.sh.index_of(left)], factors);
}

// Update value by value where some gradients are not usable. Rows with a bit in `unusable` stay unchanged and are
// counted.
template <class Gradient>
__device__ inline void update_some(const Adam& adam, int tensor, int columns, int64_t first, int count, unsigned unusable,
                                   const AdamFactors& factors, int lane, const Gradient& gradient) {
  for (int i = lane; i < count * columns; i += 32)
    if ((unusable >> (i / columns) & 1) == 0) update_value(adam, tensor, first * columns + i, gradient(i), factors);
  if (lane == 0 && unusable != 0) atomicAdd(adam.skipped + tensor, (unsigned long long)(__popc(unusable)));
}

// Return true if Adam can use these gradients: their squares must be finite too.
template <int kCount>
__device__ inline bool usable_gradient(const float* v) {
  bool usable = true;
#pragma unroll
  for (int i = 0; i < kCount; ++i) usable &= isfinite(v[i] * v[i]);
  return usable;
}

template <int kDegree>
__global__ void __launch_bounds__(kSplatThreads<kDegree>, kDegree < 4 ? 5 : 1)
    adam_splats(Scene scene, Lists lists, PictureGradient from, RawGradients to, Adam adam) {
  __shared__ WarpGradients<kDegree> warps[kSplatThreads<kDegree> / 32];
  __shared__ Camera camera;
  load_camera(scene, camera);
  const int lane = threadIdx.x & 31;
  const int64_t first = int64_t(blockIdx.x) * kSplatThreads<kDegree> + threadIdx.x / 32 * 32;
  if (first >= scene.count) return;
  const int count = int(scene.count - first < 32 ? scene.count - first : 32);
  WarpGradients<kDegree>& warp = warps[threadIdx.x / 32];
  warp.compute(scene, camera, lists, from, first, count, lane);

  float raw[kRawColumns], sh[warp.kHarmonics];
  warp.raw.get(lane, raw);
  warp.sh.get(lane, sh);
  const bool mine = lane < count;
  const unsigned unusable[kTensors] = {__ballot_sync(kAllLanes, mine && !usable_gradient<3>(raw + kRawPosition)),
                                       __ballot_sync(kAllLanes, mine && !usable_gradient<4>(raw + kRawRotation)),
                                       __ballot_sync(kAllLanes, mine && !usable_gradient<3>(raw + kRawLogScale)),
                                       __ballot_sync(kAllLanes, mine && !usable_gradient<1>(raw + kRawOpacity)),
                                       __ballot_sync(kAllLanes, mine && !usable_gradient<warp.kHarmonics>(sh))};
  __syncwarp();
  if (lists.status[kStatusOverflow] == 0) {
    const AdamFactors factors = factors_of(adam, lane);
    if ((unusable[0] | unusable[1] | unusable[2] | unusable[3] | unusable[4]) == 0) {
      update_all(adam, warp, first, count, factors, lane);
    } else {
#pragma unroll
      for (int t = 0; t < kSmall; ++t)
        update_some(adam, t, small_columns(t), first, count, unusable[t], factors, lane,
                    [&](int i) { return small_gradient(warp, t, i); });
      update_some(adam, kSmall, warp.kHarmonics, first, count, unusable[kSmall], factors, lane,
                  [&](int i) { return warp.sh.values[warp.sh.index_of(i)]; });
    }
  }
  // A deformation field receives zeros for a Gaussian with an unusable gradient.
  __syncwarp();
  if (mine && !usable_gradient<kRawUsed>(raw)) {
    const float none[kRawColumns] = {};
    warp.raw.put(lane, none);
  }
  __syncwarp();
  if (to.raw != nullptr) write_rows(warp.raw, to.raw + first * kRawColumns, count, lane);
}

}  // namespace

void splat_adam(const Scene& scene, const Lists& lists, const PictureGradient& from, const RawGradients& to, const Adam& adam,
                cudaStream_t stream) {
  if (scene.count == 0) return;
  with_degree(scene.bases, [&](auto degree) {
    constexpr int kDegree = decltype(degree)::value, kBlock = kSplatThreads<kDegree>;
    adam_splats<kDegree><<<blocks_for(scene.count, kBlock), kBlock, 0, stream>>>(scene, lists, from, to, adam);
  });
}

}  // namespace gsplat::frame
