#include "weighted_sum.h"

#include <type_traits>

#include "cuda_scratch.h"
#include "weighted_sum_math.h"

namespace gsplat::weighted_sum {
namespace {

using namespace GSPLAT_ISA::weighted_sum;

constexpr int kBatch = 256;          // splats in shared memory; also threads per tile
constexpr int kChannelsPerPass = 4;  // of the forward pass; more channels take several passes
constexpr int kWarp = 32;
constexpr int kWarpsPerBlock = 4;  // of the backward pass: one splat per warp
static_assert(kTileSize * kTileSize == kBatch);

__device__ __forceinline__ float limited(float c) { return fminf(fmaxf(c, -kMostChannel), kMostChannel); }

struct Loaded {
  float x, y, opacity, weight, conic[3];
  Contour contour;
};

// Read splat i. Its box is negative if a channel is not finite.
__device__ __forceinline__ Loaded load_splat(const Inputs& in, int64_t i) {
  Loaded s;
  s.x = in.means2d[2 * i];
  s.y = in.means2d[2 * i + 1];
  for (int k = 0; k < 3; ++k) s.conic[k] = in.conics[3 * i + k];
  s.opacity = in.opacities[i];
  s.weight = in.weights[i];
  const float mean[2] = {s.x, s.y};
  s.contour = contour_of(mean, s.conic, s.opacity, s.weight);
  for (int k = 0; k < in.channel_count; ++k)
    if (!isfinite(in.channels[i * in.channel_count + k])) s.contour.half_width = s.contour.half_height = -1.0f;
  return s;
}

__device__ __forceinline__ float power_at(const Contour& r, float dx, float dy) {
  const float across = fmaf(dx, r.a, r.b * dy);
  return fmaf(across, dx, fmaf(r.c * dy, dy, r.l));
}

// Sum D channels from `first` on in one tile per block. With `total`, also the sum of the terms.
template <int D>
__global__ void __launch_bounds__(kBatch) sum_tiles(const Inputs in, int first, bool total, float* __restrict__ sums) {
  __shared__ float4 places[kBatch];                 // x, y, half width, half height
  __shared__ float4 forms[kBatch];                  // a, b, c, l
  __shared__ float2 levels[kBatch];                 // threshold, signed weight
  __shared__ double2 factors[(D + 1) / 2][kBatch];  // channels in units of the quantum, in pairs
  const int tile = blockIdx.x, thread = threadIdx.x;
  const int64_t tiles = int64_t(in.tile_width) * in.tile_height;
  // A warp has 8x4 pixels, so that small splats concern few warps.
  const int warp = thread / kWarp, lane = thread % kWarp;
  const int px = tile % in.tile_width * kTileSize + warp % 2 * 8 + lane % 8;
  const int py = tile / in.tile_width * kTileSize + warp / 2 * 4 + lane / 8;
  const float x = float(px) + 0.5f, y = float(py) + 0.5f;
  // Sums of the doubles' bits, whose number is counted: each also adds kMagicBits.
  unsigned long long added[D + 1] = {}, terms = 0;
  const int64_t begin = max(int64_t(in.offsets[tile]), int64_t(0));
  const int64_t end = min(tile + 1 < tiles ? int64_t(in.offsets[tile + 1]) : in.instances, in.instances);
  for (int64_t batch = begin; batch < end; batch += kBatch) {
    __syncthreads();
    places[thread].z = -1.0f;
    if (batch + thread < end) {
      const int64_t i = in.flatten_ids[batch + thread];
      if (i >= 0 && i < in.count) {
        const Loaded s = load_splat(in, i);
        places[thread] = {s.x, s.y, s.contour.half_width, s.contour.half_height};
        forms[thread] = {s.contour.a, s.contour.b, s.contour.c, s.contour.l};
        levels[thread] = {s.contour.threshold, s.contour.sign * s.weight};
        const float* const own = in.channels + i * in.channel_count + first;
        const auto factor = [&](int k) { return k < D ? double(limited(own[k])) * kScale : 0.0; };
        for (int k = 0; k < D; k += 2) factors[k / 2][thread] = {factor(k), factor(k + 1)};
      }
    }
    __syncthreads();
    const int count = int(min(end - batch, int64_t(kBatch)));
    for (int j = 0; j < count; ++j) {
      const float4 place = places[j];
      const float dx = x - place.x, dy = y - place.y;
      if (!(fabsf(dx) <= place.z && fabsf(dy) <= place.w)) continue;
      const float4 form = forms[j];
      const float2 level = levels[j];
      const float power = fmaf(fmaf(dx, form.x, form.y * dy), dx, fmaf(form.z * dy, dy, form.w));
      if (!(power >= level.x)) continue;
      const float term = fminf(fmaxf(exp2f(fminf(power, form.w)) * level.y, -kMostTerm), kMostTerm);
      const double wide = double(term);
      const auto quanta = [wide](double factor) { return (unsigned long long)__double_as_longlong(wide * factor + kMagic); };
      for (int k = 0; k < D; k += 2) {
        const double2 pair = factors[k / 2][j];
        added[k] += quanta(pair.x);
        if (k + 1 < D) added[k + 1] += quanta(pair.y);
      }
      added[D] += quanta(kScale);
      ++terms;
    }
  }
  if (px >= in.width || py >= in.height) return;
  const int64_t pixels = int64_t(in.width) * in.height, pixel = int64_t(py) * in.width + px;
  const auto sum = [&](int k) { return __ll2float_rn((long long)(added[k] - terms * kMagicBits)) * kInverseScale; };
  for (int k = 0; k < D; ++k) sums[(first + k) * pixels + pixel] = sum(k);
  if (total) sums[in.channel_count * pixels + pixel] = sum(D);
}

__device__ __forceinline__ float warp_sum(float v) {
  for (int step = kWarp / 2; step > 0; step /= 2) v += __shfl_xor_sync(0xffffffffu, v, step);
  return v;
}

// One warp sums over the pixels of one splat's box: a fixed order, whatever the number of blocks. Channels beyond D are
// handled by further launches, of which the first one also computes the other gradients.
template <int D>
__global__ void __launch_bounds__(kWarpsPerBlock* kWarp)
    backward_splats(const Inputs in, const float* __restrict__ v_sums, int first, const InputGradients out) {
  const int64_t i = int64_t(blockIdx.x) * kWarpsPerBlock + threadIdx.x / kWarp;
  const int lane = threadIdx.x % kWarp;
  if (i >= in.count) return;
  const Loaded s = load_splat(in, i);
  const bool reaches = s.contour.half_height >= 0, first_pass = first == 0;
  const int64_t pixels = int64_t(in.width) * in.height;
  const float* const own = in.channels + i * in.channel_count;
  float moments[kMoments] = {}, by_channel[D] = {};
  if (reaches) {
    const Range rows = range_of(s.y, s.contour.half_height, 0, in.height);
    const Range columns = range_of(s.x, s.contour.half_width, 0, in.width);
    const int across = columns.last - columns.first + 1, down = rows.last - rows.first + 1;
    const unsigned box = across > 0 && down > 0 ? unsigned(across) * unsigned(down) : 0;
    for (unsigned at = lane; at < box; at += kWarp) {
      const int px = columns.first + int(at % across), py = rows.first + int(at / across);
      const float dx = float(px) + 0.5f - s.x, dy = float(py) + 0.5f - s.y;
      const float power = power_at(s.contour, dx, dy);
      if (!(power >= s.contour.threshold)) continue;
      const float alpha = exp2f(fminf(power, s.contour.l)) * s.contour.sign;
      if (!(fabsf(alpha * s.weight) < kMostTerm)) continue;
      const float* const v = v_sums + int64_t(py) * in.width + px;
      for (int k = 0; k < D; ++k) by_channel[k] = fmaf(v[(first + k) * pixels], alpha, by_channel[k]);
      if (!first_pass) continue;
      float gradient = v[in.channel_count * pixels];
      for (int k = 0; k < in.channel_count; ++k) gradient = fmaf(v[k * pixels], limited(own[k]), gradient);
      const float m = alpha * gradient, mx = m * dx, my = m * dy;
      moments[0] += m;
      moments[1] += mx;
      moments[2] += my;
      moments[3] += mx * dx;
      moments[4] += mx * dy;
      moments[5] += my * dy;
    }
  }
  for (int k = 0; k < kMoments; ++k) moments[k] = warp_sum(moments[k]);
  for (int k = 0; k < D; ++k) by_channel[k] = warp_sum(by_channel[k]);
  if (lane != 0) return;
  for (int k = 0; k < D; ++k) {
    const bool is_free = reaches && limited(own[first + k]) == own[first + k];
    out.channels[i * in.channel_count + first + k] = is_free ? s.weight * by_channel[k] : 0.0f;
  }
  if (!first_pass) return;
  const float w = reaches ? s.weight : 0.0f, *const m = moments;
  // A splat without pixels has moments of 0, but its conic may not be finite.
  out.means2d[2 * i] = reaches ? w * (s.conic[0] * m[1] + s.conic[1] * m[2]) : 0.0f;
  out.means2d[2 * i + 1] = reaches ? w * (s.conic[1] * m[1] + s.conic[2] * m[2]) : 0.0f;
  out.conics[3 * i] = -0.5f * w * m[3];
  out.conics[3 * i + 1] = -w * m[4];
  out.conics[3 * i + 2] = -0.5f * w * m[5];
  out.opacities[i] = reaches ? w * m[0] / s.opacity : 0.0f;
  out.weights[i] = m[0];
}

template <class Run>
void for_channels(int channels, const Run& run) {
  for (int first = 0; first < channels; first += kChannelsPerPass) switch (channels - first) {
      case 1: run(std::integral_constant<int, 1>(), first); break;
      case 2: run(std::integral_constant<int, 2>(), first); break;
      case 3: run(std::integral_constant<int, 3>(), first); break;
      default: run(std::integral_constant<int, kChannelsPerPass>(), first);
    }
}

}  // namespace

void weighted_sums_on_device(const Inputs& in, float* sums, cudaStream_t stream) {
  const unsigned tiles = unsigned(in.tile_width) * unsigned(in.tile_height);
  if (tiles == 0) return;
  for_channels(in.channel_count, [&](auto d, int first) {
    sum_tiles<decltype(d)::value><<<tiles, kBatch, 0, stream>>>(in, first, first == 0, sums);
  });
}

void weighted_sums_backward_on_device(const Inputs& in, const float* v_sums, const InputGradients& out, cudaStream_t stream) {
  if (in.count == 0) return;
  const unsigned blocks = blocks_for(in.count, kWarpsPerBlock);
  for_channels(in.channel_count, [&](auto d, int first) {
    backward_splats<decltype(d)::value><<<blocks, kWarpsPerBlock * kWarp, 0, stream>>>(in, v_sums, first, out);
  });
}

}  // namespace gsplat::weighted_sum
