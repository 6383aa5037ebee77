#include <algorithm>

#include "../spherical_harmonics/spherical_harmonics_bases.h"
#include "cuda_check.h"
#include "cuda_scratch.h"
#include "stochastic.h"
#include "stochastic_math.h"

namespace gsplat::stochastic {
namespace {

using namespace GSPLAT_ISA::stochastic;
using GSPLAT_ISA::philox;
using GSPLAT_ISA::unit_interval;
namespace bases = GSPLAT_ISA::spherical_harmonics;

constexpr int kCountBits = 42;  // of a round's counter: fragments below, splats above
constexpr unsigned kExpandBlocks = 2048;
constexpr unsigned kWarp = 0xffffffffu;

// Load a splat; return false if it is certainly invisible, before the rest of it is read.
__device__ bool load(const Scene& scene, const ProjectionInput& in, int64_t row, Loaded& one) {
  const auto seen = [&](const float* mean) {
    const float* m = in.viewmat;
    const float z = m[8] * mean[0] + m[9] * mean[1] + m[10] * mean[2] + m[11];
    return z >= 0.5f * in.near_plane && one.opacity >= 0.5f * gsplat::kAlphaCutoff;
  };
  float quat[4], log_scales[3];
  if (scene.packed != nullptr) {
    const Decoded d = decode(scene, row);
    one.opacity = d.opacity;
    if (!seen(d.mean)) return false;
    for (int k = 0; k < 3; ++k) one.mean[k] = d.mean[k];
    for (int k = 0; k < 4; ++k) quat[k] = d.quat[k];
    for (int k = 0; k < 3; ++k) log_scales[k] = d.log_scales[k];
  } else {
    for (int k = 0; k < 3; ++k) one.mean[k] = scene.means[3 * row + k];
    one.opacity = scene.covars != nullptr ? scene.opacities[row] : 1.0f / (1.0f + expf(-scene.logits[row]));
    if (!seen(one.mean)) return false;
    if (scene.covars != nullptr) {
      Symmetric3 sigma;
      for (int k = 0; k < 6; ++k) sigma.v[k] = scene.covars[6 * row + k];
      one.geometry = geometry_of(sigma);
      return true;
    }
    for (int k = 0; k < 4; ++k) quat[k] = scene.quats[4 * row + k];
    for (int k = 0; k < 3; ++k) log_scales[k] = scene.log_scales[3 * row + k];
  }
  float scales[3];
  for (int k = 0; k < 3; ++k) scales[k] = expf(log_scales[k]);
  one.geometry = geometry_of(quat, scales);
  return true;
}

__device__ bool project_row(const Scene& scene, const Request& request, int64_t row, Splat& out) {
  const ProjectionInput in = projection_input(request);
  Loaded one;
  if (!load(scene, in, row, one)) return false;
  const Projected p = project(in, one.mean, one.geometry, &one.opacity, false);
  if (!p.valid) return false;
  Plane plane = {};
  if (request.pixel_order) plane = plane_of(in, one, scene.covars == nullptr);
  const Lane lane = {p.u,
                     p.v,
                     p.depth,
                     {p.conic[0], p.conic[1], p.conic[2]},
                     {p.half_x, p.half_y},
                     p.determinant,
                     one.opacity,
                     {plane.coefficients[0], plane.coefficients[1], plane.coefficients[2]},
                     plane.reach};
  const uint32_t key = scene.index != nullptr ? uint32_t(scene.index[row]) : uint32_t(row);
  return finish_splat(request, lane, uint32_t(row), key, out);
}

__device__ void lower(uint64_t* place, uint64_t word) {
  atomicMin(reinterpret_cast<unsigned long long*>(place), static_cast<unsigned long long>(word));
}

// Read a word of the frame buffer, possibly outdated. Words only decrease, so an outdated one costs an unnecessary
// atomic operation and nothing else.
__device__ uint64_t seen_at(const uint64_t* place) { return __ldcg(reinterpret_cast<const unsigned long long*>(place)); }

template <int kSlots>
__device__ void draw_fragment(const Request& request, const Splat& s, uint32_t number, uint64_t* frame) {
  const uint32_t columns = (s.size & 0xffff) + 1, y = number / columns, x = number - y * columns;
  const int32_t column = int32_t((s.corner & 0xffff) + x), row = int32_t((s.corner >> 16) + y);
  const float inverse = 1.0f / float(request.supersampling);
  const float px = (float(column) + 0.5f) * inverse, py = (float(row) + 0.5f) * inverse;
  const float dx = px - s.u, dy = py - s.v;
  const float power = s.log2_opacity - (s.conic[0] * dx * dx + 2 * s.conic[1] * dx * dy + s.conic[2] * dy * dy);
  if (!(power >= gsplat::kLog2AlphaCutoff)) return;
  float z = s.z;
  if (request.pixel_order) {
    const float t = 1.0f / (s.plane[0] * px + s.plane[1] * py + s.plane[2]);
    // A plane seen edge-on has no depth there (infinite, negative or NaN).
    const float near = fmaxf(s.z - s.extra, kNearPlane);
    if (t > 0) z = fmaxf(fminf(t, s.z + s.extra), near);
  }
  const uint64_t word = word_of(z, s.row);
  const int64_t subpixel = int64_t(row) * request.columns() + column;
  uint64_t* place = frame + subpixel * kSlots;
  uint64_t seen[kSlots];
  bool hidden = true;
  for (int slot = 0; slot < kSlots; ++slot) {
    seen[slot] = seen_at(place + slot);
    hidden &= seen[slot] <= word;
  }
  if (hidden) return;
  const float alpha = fminf(exp2f(power), gsplat::kMaxAlpha);
  uint32_t c[4] = {uint32_t(subpixel), s.key, request.sample / kMaxSlots, kAlphaStream};
  philox(c, request.seed[0], request.seed[1]);
  if constexpr (kSlots == 1) {
    const uint32_t lane = request.sample % kMaxSlots;
    const uint32_t drawn = lane < 2 ? (lane == 0 ? c[0] : c[1]) : (lane == 2 ? c[2] : c[3]);
    if (unit_interval(drawn) < alpha) lower(place, word);
  } else {
    for (int slot = 0; slot < kSlots; ++slot)
      if ((request.active >> slot & 1) && word < seen[slot] && unit_interval(c[slot]) < alpha) lower(place + slot, word);
  }
}

template <int kMethod, int kSlots>
__device__ void draw_item(const Request& request, const Splat& s, uint32_t number, uint64_t* frame) {
  if constexpr (kMethod == kFragments) {
    draw_fragment<kSlots>(request, s, number, frame);
  } else if (s.extra < 0) {
    const uint32_t columns = (s.size & 0xffff) + 1, y = number / columns, x = number - y * columns;
    const int32_t column = int32_t((s.corner & 0xffff) + x), row = int32_t((s.corner >> 16) + y);
    uint64_t* place = frame + int64_t(row) * request.columns() + column;
    const uint64_t word = word_of(s.z, s.row);
    if (word < seen_at(place) && has_point(request, s, column, row)) lower(place, word);
  } else {
    const int64_t subpixel = point_of(request, s, number);
    const uint64_t word = word_of(s.z, s.row);
    if (subpixel >= 0 && word < seen_at(frame + subpixel)) lower(frame + subpixel, word);
  }
}

// Draws the small splats of rows `first` to `end` - 1, and appends the large ones to the queue. The sum of one atomic
// addition per block places splats and fragments in the same order, so `starts` increases.
template <int kMethod, int kSlots>
__global__ void __launch_bounds__(kThreads)
    draw_small(Scene scene, Request request, Queue queue, uint64_t* frame, int64_t first, int64_t end, int64_t round) {
  const int64_t row = first + int64_t(blockIdx.x) * kThreads + threadIdx.x;
  Splat s;
  const bool drawn = row < end && project_row(scene, request, row, s);
  const bool large = drawn && s.count > kInlineFragments;
  if (drawn && !large)
    for (uint32_t k = 0; k < s.count; ++k) draw_item<kMethod, kSlots>(request, s, k, frame);

  __shared__ unsigned long long sums[kThreads / 32];
  __shared__ unsigned long long base;
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  const unsigned long long mine = large ? (1ull << kCountBits) + s.count : 0;
  unsigned long long sum = mine;
  for (int offset = 1; offset < 32; offset *= 2) {
    const unsigned long long other = __shfl_up_sync(kWarp, sum, offset);
    if (lane >= offset) sum += other;
  }
  if (lane == 31) sums[warp] = sum;
  __syncthreads();
  if (threadIdx.x == 0) {
    unsigned long long total = 0;
    for (int w = 0; w < kThreads / 32; ++w) {
      const unsigned long long of_warp = sums[w];
      sums[w] = total;
      total += of_warp;
    }
    base = total > 0 ? atomicAdd(queue.rounds + round, total) : 0;
  }
  __syncthreads();
  if (!large) return;
  const unsigned long long at = base + sums[warp] + sum - mine;
  const int64_t place = int64_t(at >> kCountBits);
  queue.splats[place] = s;
  queue.starts[place] = at & ((1ull << kCountBits) - 1);
}

__device__ unsigned or_of_warp(unsigned x) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  return __reduce_or_sync(kWarp, x);
#else
  for (int offset = 16; offset > 0; offset /= 2) x |= __shfl_xor_sync(kWarp, x, offset);
  return x;
#endif
}

// Draws the queue of one round, one fragment or point per thread. A warp has a range of them and finds the first one's
// splat once. Every splat in the queue has more than kInlineFragments fragments, so 32 of them belong to few splats.
template <int kMethod, int kSlots>
__global__ void __launch_bounds__(kThreads) draw_large(Request request, Queue queue, uint64_t* frame, int64_t round) {
  const unsigned long long packed = queue.rounds[round];
  const int64_t splats = int64_t(packed >> kCountBits);
  const uint64_t total = packed & ((1ull << kCountBits) - 1);
  const int lane = threadIdx.x % 32;
  const uint64_t warps = uint64_t(gridDim.x) * (kThreads / 32);
  const uint64_t warp = uint64_t(blockIdx.x) * (kThreads / 32) + threadIdx.x / 32;
  uint64_t span = (total / warps + 31) / 32 * 32;
  span = span < 32 ? 32 : (span > 1024 ? 1024 : span);
  for (uint64_t begin = warp * span; begin < total; begin += warps * span) {
    int64_t low = 0, width = splats;  // the last splat with starts <= begin is in low .. low + width - 1
    while (width > 1) {
      const int64_t step = (width + 31) / 32, probe = lane * step;
      const bool before = probe < width && queue.starts[low + probe] <= begin;
      const int last = __popc(__ballot_sync(kWarp, before)) - 1;
      low += last * step;
      width = step < width - last * step ? step : width - last * step;
    }
    const uint64_t end = begin + span < total ? begin + span : total;
    for (uint64_t group = begin; group < end; group += 32) {
      const bool listed = low + lane < splats;
      const uint64_t start = listed ? queue.starts[low + lane] : ~0ull;
      const unsigned starting = lane > 0 && listed && start < group + 32 ? 1u << unsigned(start - group) : 0;
      const unsigned starts = or_of_warp(starting);
      const uint64_t number = group + lane;
      if (number < end) {
        const int64_t place = low + __popc(starts & ((2u << lane) - 1));
        const Splat s = queue.splats[place];
        draw_item<kMethod, kSlots>(request, s, uint32_t(number - queue.starts[place]), frame);
      }
      __syncwarp();
      low += __popc(starts);
    }
  }
}

template <int degree>
__global__ void __launch_bounds__(kThreads) resolve(Scene scene, Request request, const uint64_t* frame, float* sums) {
  const int64_t pixel = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (pixel >= int64_t(request.width) * request.height) return;
  constexpr int used = (degree + 1) * (degree + 1);
  float centre[3], sum[5];
  for (int i = 0; i < 3; ++i) {
    centre[i] = 0;
    for (int k = 0; k < 3; ++k) centre[i] -= request.viewmat[4 * k + i] * request.viewmat[4 * k + 3];
  }
  for (int k = 0; k < 5; ++k) sum[k] = sums[5 * pixel + k];
  const int64_t y = pixel / request.width, x = pixel - y * request.width;
  const int factor = request.supersampling;
  for (int sub = 0; sub < factor * factor; ++sub) {
    const int64_t subpixel = (y * factor + sub / factor) * request.columns() + x * factor + sub % factor;
    for (int slot = 0; slot < request.slots; ++slot) {
      if (!(request.active >> slot & 1)) continue;
      const uint64_t word = frame[subpixel * request.slots + slot];
      if (word == kEmpty) continue;
      const uint32_t row = uint32_t(word);
      float mean[3], decoded[3 * used], b[used], colour[3] = {};
      const float* sh = decoded;
      if (scene.packed != nullptr) {
        decode_mean(scene, row, mean);
        decode_sh(scene, row, decoded);
      } else {
        for (int k = 0; k < 3; ++k) mean[k] = scene.means[3 * int64_t(row) + k];
        sh = scene.sh + int64_t(row) * scene.bases * 3;
      }
      const float d[3] = {mean[0] - centre[0], mean[1] - centre[1], mean[2] - centre[2]};
      const float inverse_norm = 1.0f / sqrtf(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
      bases::bases_at<degree>(d[0] * inverse_norm, d[1] * inverse_norm, d[2] * inverse_norm, b);
      for (int n = 0; n < used; ++n)
        for (int k = 0; k < 3; ++k) colour[k] += b[n] * sh[3 * n + k];
      for (int k = 0; k < 3; ++k) sum[k] += colour[k] + 0.5f > 0 ? colour[k] + 0.5f : 0;
      sum[3] += 1;
      sum[4] += __uint_as_float(uint32_t(word >> 32));
    }
  }
  for (int k = 0; k < 5; ++k) sums[5 * pixel + k] = sum[k];
}

template <int kMethod, int kSlots>
void draw(const Scene& scene, const Request& request, const Queue& queue, uint64_t* frame, cudaStream_t stream) {
  int64_t round = 0;
  for (int64_t first = 0; first < scene.count; first += queue.capacity, ++round) {
    const int64_t end = std::min(first + queue.capacity, scene.count);
    draw_small<kMethod, kSlots>
        <<<blocks_for(end - first), kThreads, 0, stream>>>(scene, request, queue, frame, first, end, round);
    draw_large<kMethod, kSlots><<<kExpandBlocks, kThreads, 0, stream>>>(request, queue, frame, round);
  }
}

__global__ void __launch_bounds__(kThreads)
    draw_poisson(const double* rates, int64_t rate_count, int64_t count, uint64_t seed, int64_t* out) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= rate_count * count) return;
  const uint32_t words[2] = {uint32_t(seed), uint32_t(seed >> 32)};
  out[i] = poisson(rates[i / count], uint32_t(i / count), uint32_t(i % count), words);
}

}  // namespace

void draw_on_device(const Scene& scene, const Request& request, const Queue& queue, uint64_t* frame, cudaStream_t stream) {
  if (request.method == kPoints)
    draw<kPoints, 1>(scene, request, queue, frame, stream);
  else if (request.slots == 1)
    draw<kFragments, 1>(scene, request, queue, frame, stream);
  else
    draw<kFragments, kMaxSlots>(scene, request, queue, frame, stream);
}

void resolve_on_device(const Scene& scene, const Request& request, const uint64_t* frame, float* sums, cudaStream_t stream) {
  const unsigned blocks = blocks_for(int64_t(request.width) * request.height);
  switch (scene.degree) {
    case 0: resolve<0><<<blocks, kThreads, 0, stream>>>(scene, request, frame, sums); break;
    case 1: resolve<1><<<blocks, kThreads, 0, stream>>>(scene, request, frame, sums); break;
    case 2: resolve<2><<<blocks, kThreads, 0, stream>>>(scene, request, frame, sums); break;
    case 3: resolve<3><<<blocks, kThreads, 0, stream>>>(scene, request, frame, sums); break;
    default: resolve<4><<<blocks, kThreads, 0, stream>>>(scene, request, frame, sums); break;
  }
}

void poisson_on_device(const double* rates, int64_t rate_count, int64_t count, uint64_t seed, int64_t* out, cudaStream_t stream) {
  if (rate_count * count == 0) return;
  draw_poisson<<<blocks_for(rate_count * count), kThreads, 0, stream>>>(rates, rate_count, count, seed, out);
}

}  // namespace gsplat::stochastic
