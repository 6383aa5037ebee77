// Front-to-back blending of ray depths and channels, and its gradient traversed back to front.
//
// A block of four warps has a window of 16x16 pixels, as in ../compositing. In the backward pass each warp sums the terms of
// a splat over its pixels, the block adds the sums of its warps, and every instance (a splat in a tile) has its own row. A
// splat's rows are summed in list order. There are no atomics, so results are bitwise reproducible.
#include "../compositing/gather_rows.cuh"
#include "../compositing/warp_sums.cuh"
#include "ray_blending_math.h"

namespace gsplat::ray_blending {
namespace {

using namespace blending;
using compositing::Instances;
using compositing::Place;
using compositing::record_at;
using device::ray_blending::Fraction;
using device::ray_blending::fraction_at;
using device::ray_blending::splat_gradients;

constexpr int kBatch = 32;                      // splats per step of the backward pass
constexpr int kStagedRay = 12;                  // floats per staged ray
constexpr int kSums = kMoments + kRaySums;      // values of a row before the channels
constexpr int kMaxSums = kSums + kMaxChannels;  // 32
static_assert(kMaxSums <= 32);

// Mark splats with a ray coefficient or channel that is not finite as unusable.
__global__ void check_values(Inputs in, Record<0>* records) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.splats.count) return;
  bool usable = true;
  for (int r = 0; r < kRayNumbers; ++r) usable = usable && isfinite(in.rays[i * kRayNumbers + r]);
  for (int d = 0; d < in.channels; ++d) usable = usable && isfinite(in.values[i * in.channels + d]);
  if (!usable) records[i] = faint_record<0>();
}

const Record<0>* usable_records(const Inputs& in, CudaScratch& scratch, cudaStream_t stream) {
  Record<0>* const records = compositing::records_of<0>(in.splats, scratch, stream);
  if (in.splats.count > 0) check_values<<<blocks_for(in.splats.count), kThreads, 0, stream>>>(in, records);
  return records;
}

// Copy the ray and the channels of the splat at a list position to shared memory; zeros if its index is out of range.
template <int D>
__device__ inline void stage_values(const Inputs& in, int position, float* ray, float* values) {
  const int id = in.splats.flatten_ids[position];
  const bool known = uint32_t(id) < uint64_t(in.splats.count);
  for (int r = 0; r < kRayNumbers; ++r) ray[r] = known ? in.rays[int64_t(id) * kRayNumbers + r] : 0;
  for (int d = 0; d < D; ++d) values[d] = known && d < in.channels ? in.values[int64_t(id) * in.channels + d] : 0;
}

template <int D>
__global__ void __launch_bounds__(kBlockThreads) blend(Inputs in, const Record<0>* records, Pixels out) {
  __shared__ Record<0> staged[kBlockThreads];
  __shared__ float staged_rays[kBlockThreads][kStagedRay];
  __shared__ float staged_values[kBlockThreads][D > 0 ? D : 1];
  const Place place(in.splats);
  const Window w = place.window(in.splats);
  const int lane = threadIdx.x & 31;
  const float center_x = float(w.x) + 0.5f;
  float through[kPixelsEach], first[kPixelsEach], offset_sum[kPixelsEach], square_sum[kPixelsEach], median[kPixelsEach];
  float sum[kPixelsEach][D > 0 ? D : 1];
  int last[kPixelsEach], median_at[kPixelsEach];
  bool open[kPixelsEach];
  for (int p = 0; p < kPixelsEach; ++p) {
    through[p] = 1;
    first[p] = offset_sum[p] = square_sum[p] = median[p] = 0;
    last[p] = median_at[p] = -1;
    open[p] = w.inside[p];
    for (int d = 0; d < D; ++d) sum[p][d] = 0;
  }
  for (int begin = w.begin; begin < w.end; begin += kBlockThreads) {
    if (!__syncthreads_or(open[0] || open[1])) break;
    const bool has = begin + int(threadIdx.x) < w.end;
    staged[threadIdx.x] = has ? record_at(in.splats, records, begin + int(threadIdx.x)) : faint_record<0>();
    if (has) stage_values<D>(in, begin + int(threadIdx.x), staged_rays[threadIdx.x], staged_values[threadIdx.x]);
    __syncthreads();
    for (int group = 0; group < kBlockThreads && __any_sync(kAll, open[0] || open[1]); group += 32) {
      unsigned hits = __ballot_sync(kAll, reaches(staged[group + lane], float(w.quadrant_x) + 0.5f, float(w.quadrant_y) + 0.5f));
      for (; hits != 0; hits &= hits - 1) {
        const int i = group + __ffs(int(hits)) - 1;
        const float* const ray = staged_rays[i];
#pragma unroll
        for (int p = 0; p < kPixelsEach; ++p) {
          const Falloff f = falloff(staged[i], center_x, float(w.y[p]) + 0.5f);
          if (!(open[p] && f.power >= kLog2AlphaCutoff && f.power <= staged[i].cap)) continue;
          const float alpha = exp2_fast(fminf(f.power, in.splats.alpha.log2_most));
          const float behind = fmaf(-alpha, through[p], through[p]);
          if (!(behind > kMinTransmittance)) {
            open[p] = false;
            continue;
          }
          const float weight = alpha * through[p];
          const Fraction fraction = fraction_at(ray, f.dx, f.dy);
          const float widen = 1.0f / fraction.denominator;
          const float depth = fminf(fmaxf(fraction.numerator * widen, ray[kZ] - ray[kReach]), ray[kZ] + ray[kReach]);
          if (last[p] < 0) first[p] = depth;
          const float offset = depth - first[p], weighted = weight * offset;
          offset_sum[p] += weighted;
          square_sum[p] = fmaf(weighted, offset, fmaf(weight, widen * ray[kVariance], square_sum[p]));
          if (through[p] > 0.5f && behind <= 0.5f) {
            median[p] = depth;
            median_at[p] = begin + i;
          }
#pragma unroll
          for (int d = 0; d < D; ++d) sum[p][d] = fmaf(weight, staged_values[i][d], sum[p][d]);
          through[p] = behind;
          last[p] = begin + i;
        }
      }
    }
  }
  for (int p = 0; p < kPixelsEach; ++p) {
    if (!w.inside[p]) continue;
    const int64_t pixel = place.pixel(in.splats, w, p);
    const float alpha = 1 - through[p], mean = alpha > 0 ? offset_sum[p] / alpha : 0;
    out.alphas[pixel] = alpha;
    out.depths[pixel] = first[p] + mean;
    out.medians[pixel] = median[p];
    out.variances[pixel] = alpha > 0 ? fmaxf(square_sum[p] / alpha - mean * mean, 0) : 0;
    out.last[pixel] = last[p];
    out.median_at[pixel] = median_at[p];
#pragma unroll
    for (int d = 0; d < D; ++d)
      if (d < in.channels) out.values[pixel * in.channels + d] = sum[p][d];
  }
}

// A pixel's state in the backward pass.
template <int D>
struct PixelState {
  float through, behind;          // transmittance in front of the splats visited so far; sum of w g of the splats behind
  float depth, v_mean, v_median;  // v_mean: dL/d(mean depth) / alpha
  int last, median_at;
  float v_values[D > 0 ? D : 1];
};

// Add a pixel's terms of a splat to `v`, and advance the pixel to in front of the splat.
template <int D>
__device__ inline void add_terms(const Falloff& f, const float* ray, const float* values, int position, const AlphaLimit& limit,
                                 PixelState<D>& pixel, float (&v)[32]) {
  const float alpha = exp2_fast(fminf(f.power, limit.log2_most)), widen = reciprocal(1 - alpha);
  const float through = pixel.through * widen, weight = alpha * through;
  const Fraction fraction = fraction_at(ray, f.dx, f.dy);
  const float inverse = 1.0f / fraction.denominator, free = fraction.numerator * inverse;
  const float low = ray[kZ] - ray[kReach], high = ray[kZ] + ray[kReach], depth = fminf(fmaxf(free, low), high);
  const float v_depth = fmaf(weight, pixel.v_mean, position == pixel.median_at ? pixel.v_median : 0);
  const bool within = free >= low && free <= high;
  const float a = within ? v_depth * inverse : 0, b = -a * depth, limited = within ? 0 : v_depth;
  const float bx = b * f.dx, by = b * f.dy;
  float* const r = v + kMoments;
  r[0] += a;
  r[1] = fmaf(a, f.dx, r[1]);
  r[2] = fmaf(a, f.dy, r[2]);
  r[3] += b;
  r[4] += bx;
  r[5] += by;
  r[6] = fmaf(bx, f.dx, r[6]);
  r[7] = fmaf(bx, f.dy, r[7]);
  r[8] = fmaf(by, f.dy, r[8]);
  r[9] += limited;
  r[10] += free > high ? limited : -limited;
  float g = pixel.v_mean * (depth - pixel.depth);
#pragma unroll
  for (int d = 0; d < D; ++d) {
    g = fmaf(pixel.v_values[d], values[d], g);
    v[kSums + d] = fmaf(weight, pixel.v_values[d], v[kSums + d]);
  }
  const float v_alpha = fmaf(through, g, -(pixel.behind * widen));
  pixel.through = through;
  pixel.behind = fmaf(weight, g, pixel.behind);
  // Where alpha is clamped to its maximum, opacity and shape have no gradient.
  const float s = f.power <= limit.log2_most ? alpha * v_alpha : 0, sx = s * f.dx, sy = s * f.dy;
  v[0] += s;
  v[1] += sx;
  v[2] += sy;
  v[3] = fmaf(sx, f.dx, v[3]);
  v[4] = fmaf(sx, f.dy, v[4]);
  v[5] = fmaf(sy, f.dy, v[5]);
}

// Write the gradient rows of a window's instances. `rows` holds kSums + channels floats per instance.
template <int D>
__global__ void __launch_bounds__(kBlockThreads)
    blend_backward(Inputs in, const Record<0>* records, PixelGradients from, float* rows) {
  __shared__ Record<0> staged[kBatch];
  __shared__ float staged_rays[kBatch][kStagedRay];
  __shared__ float staged_values[kBatch][D > 0 ? D : 1];
  __shared__ float sums[kWarps][kBatch][33];  // padded against bank conflicts
  const Place place(in.splats);
  const Window w = place.window(in.splats);
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32, row_size = kSums + in.channels;
  const float center_x = float(w.x) + 0.5f;
  PixelState<D> pixels[kPixelsEach];
  for (int p = 0; p < kPixelsEach; ++p) {
    PixelState<D>& s = pixels[p];
    s = {1, 0, 0, 0, 0, -1, -1, {}};
    if (!w.inside[p]) continue;
    const int64_t at = place.pixel(in.splats, w, p);
    const float alpha = from.alphas[at];
    s.through = 1 - alpha;
    s.behind = -s.through * from.v_alphas[at];
    s.depth = from.depths[at];
    s.v_mean = alpha > 0 ? from.v_depths[at] / alpha : 0;
    s.v_median = from.v_medians[at];
    s.last = from.last[at];
    s.median_at = from.median_at[at];
    for (int d = 0; d < D; ++d) s.v_values[d] = d < in.channels ? from.v_values[at * in.channels + d] : 0;
  }
  const int warp_furthest = __reduce_max_sync(kAll, max(pixels[0].last, pixels[1].last));
  const int furthest = block_furthest(warp_furthest);
  const int end = furthest < w.begin ? w.begin : min(furthest + 1, w.end);
  for (int64_t e = threadIdx.x; e < int64_t(w.end - end) * row_size; e += kBlockThreads) rows[int64_t(end) * row_size + e] = 0;
  for (int stop = end; stop > w.begin; stop -= kBatch) {
    const int first = max(stop - kBatch, w.begin), count = stop - first;
    __syncthreads();
    if (int(threadIdx.x) < kBatch) {
      const bool has = int(threadIdx.x) < count;
      staged[threadIdx.x] = has ? record_at(in.splats, records, first + int(threadIdx.x)) : faint_record<0>();
      if (has) stage_values<D>(in, first + int(threadIdx.x), staged_rays[threadIdx.x], staged_values[threadIdx.x]);
    }
    for (int e = threadIdx.x; e < kWarps * kBatch * 33; e += kBlockThreads) (&sums[0][0][0])[e] = 0;
    __syncthreads();
    unsigned hits = __ballot_sync(
        kAll, first + lane <= warp_furthest && reaches(staged[lane], float(w.quadrant_x) + 0.5f, float(w.quadrant_y) + 0.5f));
    while (hits != 0) {
      const int i = 31 - __clz(int(hits)), position = first + i;
      hits &= ~(1u << i);
      float v[32] = {};
      bool used = false;
#pragma unroll
      for (int p = 0; p < kPixelsEach; ++p) {
        const Falloff f = falloff(staged[i], center_x, float(w.y[p]) + 0.5f);
        if (!(f.power >= kLog2AlphaCutoff && f.power <= staged[i].cap && position <= pixels[p].last)) continue;
        used = true;
        add_terms<D>(f, staged_rays[i], staged_values[i], position, in.splats.alpha, pixels[p], v);
      }
      if (!__any_sync(kAll, used)) continue;
      float low[16], high[16];
#pragma unroll
      for (int k = 0; k < 16; ++k) low[k] = v[k], high[k] = v[16 + k];
      const float low_sum = compositing::warp_sums<8>(low, lane), high_sum = compositing::warp_sums<8>(high, lane);
      if ((lane & 1) == 0) {
        sums[warp][i][lane / 2] = low_sum;
        sums[warp][i][16 + lane / 2] = high_sum;
      }
    }
    __syncthreads();
    for (int e = threadIdx.x; e < count * row_size; e += kBlockThreads) {
      const int i = e / row_size, r = e % row_size;
      float total = 0;
      for (int k = 0; k < kWarps; ++k) total += sums[k][i][r];
      rows[int64_t(first) * row_size + e] = total;
    }
  }
}

// Sum the rows of each splat in list order, one thread per splat and value.
__global__ void sum_rows(Inputs in, const uint32_t* positions, const uint2* ranges, const float* rows, float* sums) {
  const int row_size = kSums + in.channels;
  const int64_t e = int64_t(blockIdx.x) * kThreads + threadIdx.x, splat = e / row_size, value = e % row_size;
  if (splat >= in.splats.count) return;
  const uint2 range = ranges[splat];
  float total = 0;
#pragma unroll 4
  for (uint32_t i = range.x; i < range.y; ++i) total += rows[int64_t(positions[i]) * row_size + value];
  sums[e] = total;
}

__global__ void convert_sums(Inputs in, const Record<0>* records, const float* sums, InputGradients out) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.splats.count) return;
  const bool usable = records[i].l > -INFINITY;
  float own[kSums] = {}, conic[3] = {}, ray[kRayNumbers] = {};
  if (usable) {
    for (int r = 0; r < kSums; ++r) own[r] = sums[i * (kSums + in.channels) + r];
    for (int r = 0; r < 3; ++r) conic[r] = in.splats.conics[3 * i + r];
    for (int r = 0; r < kRayNumbers; ++r) ray[r] = in.rays[kRayNumbers * i + r];
  }
  splat_gradients(own, conic, ray, usable ? in.splats.opacities[i] : 1, out.means2d + 2 * i, out.conics + 3 * i,
                  out.opacities + i, out.rays + kRayNumbers * i);
  for (int d = 0; d < in.channels; ++d)
    out.values[i * in.channels + d] = usable ? sums[i * (kSums + in.channels) + kSums + d] : 0;
}

// Raise most[i] to the largest blending weight of splat i. Positive floats order as integers, and the maximum does not
// depend on the order of threads.
__global__ void __launch_bounds__(kBlockThreads)
    raise_contributions(compositing::Inputs in, const Record<0>* records, int* most) {
  __shared__ Record<0> staged[kBlockThreads];
  __shared__ int staged_ids[kBlockThreads];
  const Place place(in);
  const Window w = place.window(in);
  const int lane = threadIdx.x & 31;
  const float center_x = float(w.x) + 0.5f;
  float through[kPixelsEach];
  bool open[kPixelsEach];
  for (int p = 0; p < kPixelsEach; ++p) through[p] = 1, open[p] = w.inside[p];
  for (int begin = w.begin; begin < w.end; begin += kBlockThreads) {
    if (!__syncthreads_or(open[0] || open[1])) break;
    const bool has = begin + int(threadIdx.x) < w.end;
    staged[threadIdx.x] = has ? record_at(in, records, begin + int(threadIdx.x)) : faint_record<0>();
    staged_ids[threadIdx.x] = has ? in.flatten_ids[begin + int(threadIdx.x)] : 0;
    __syncthreads();
    for (int group = 0; group < kBlockThreads && __any_sync(kAll, open[0] || open[1]); group += 32) {
      unsigned hits = __ballot_sync(kAll, reaches(staged[group + lane], float(w.quadrant_x) + 0.5f, float(w.quadrant_y) + 0.5f));
      for (; hits != 0; hits &= hits - 1) {
        const int i = group + __ffs(int(hits)) - 1;
        int largest = 0;
        for (int p = 0; p < kPixelsEach; ++p) {
          const float power = falloff(staged[i], center_x, float(w.y[p]) + 0.5f).power;
          if (!(open[p] && power >= kLog2AlphaCutoff && power <= staged[i].cap)) continue;
          const float alpha = exp2_fast(fminf(power, in.alpha.log2_most)), behind = fmaf(-alpha, through[p], through[p]);
          if (!(behind > kMinTransmittance)) {
            open[p] = false;
            continue;
          }
          largest = max(largest, __float_as_int(alpha * through[p]));
          through[p] = behind;
        }
        largest = __reduce_max_sync(kAll, largest);
        if (lane == 0 && largest > 0) atomicMax(most + staged_ids[i], largest);
      }
    }
  }
}

// Call run with the smallest compiled number of channels that is sufficient.
template <class Run>
void with_channels(int channels, const Run& run) {
  if (channels == 0) return run(std::integral_constant<int, 0>());
  if (channels <= 3) return run(std::integral_constant<int, 3>());
  if (channels <= 8) return run(std::integral_constant<int, 8>());
  return run(std::integral_constant<int, kMaxChannels>());
}

}  // namespace

void blend_on_device(const Inputs& in, const Pixels& out, CudaScratch& scratch, cudaStream_t stream) {
  const int64_t blocks = in.splats.tiles();
  if (blocks == 0) return;
  const Record<0>* const records = usable_records(in, scratch, stream);
  with_channels(in.channels, [&](auto channels) {
    blend<decltype(channels)::value><<<unsigned(blocks), kBlockThreads, 0, stream>>>(in, records, out);
  });
}

void contributions_on_device(const compositing::Inputs& in, float* most, CudaScratch& scratch, cudaStream_t stream) {
  if (in.tiles() == 0 || in.count == 0) return;
  const Record<0>* const records = compositing::records_of<0>(in, scratch, stream);
  raise_contributions<<<unsigned(in.tiles()), kBlockThreads, 0, stream>>>(in, records, reinterpret_cast<int*>(most));
}

void blend_backward_on_device(const Inputs& in, const PixelGradients& from, const InputGradients& out, CudaScratch& scratch,
                              cudaStream_t stream) {
  const int64_t blocks = in.splats.tiles(), count = in.splats.count;
  if (count == 0) return;
  const int row_size = kSums + in.channels;
  const Record<0>* const records = usable_records(in, scratch, stream);
  float* const rows = scratch.array<float>(in.splats.instances * row_size);
  float* const sums = scratch.array<float>(count * row_size);
  if (blocks > 0)
    with_channels(in.channels, [&](auto channels) {
      blend_backward<decltype(channels)::value><<<unsigned(blocks), kBlockThreads, 0, stream>>>(in, records, from, rows);
    });
  const Instances instances = compositing::by_splat(in.splats, scratch, stream);
  sum_rows<<<blocks_for(count * row_size), kThreads, 0, stream>>>(in, instances.positions, instances.ranges, rows, sums);
  convert_sums<<<blocks_for(count), kThreads, 0, stream>>>(in, records, sums, out);
}

}  // namespace gsplat::ray_blending
