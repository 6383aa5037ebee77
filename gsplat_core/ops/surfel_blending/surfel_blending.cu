// Front-to-back blending of surfels, and its gradient traversed back to front.
//
// A block of four warps has a window of 16x16 pixels, as in ../compositing. In the backward pass each warp sums the terms of
// a surfel over its pixels, the block adds the sums of its warps, and every instance (a surfel in a window) has its own row.
// A surfel's rows are summed in list order. There are no atomics, so results are bitwise reproducible.
#include "../compositing/gather_rows.cuh"
#include "../compositing/row_sums.cuh"
#include "../compositing/warp_sums.cuh"
#include "surfel_blending_math.h"

namespace gsplat::surfel_blending {
namespace {

using namespace blending;
using compositing::Instances;
using compositing::Place;
namespace math = GSPLAT_ISA::surfel_blending;
using math::Hit;

constexpr int kBatch = 32;  // surfels per step of the backward pass

using Bounds = blending::Record<0>;

__global__ void make_records(Inputs in, Record* records, Bounds* bounds) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.splats.count) return;
  const float *mean = in.splats.means2d + 2 * i, *transform = in.transforms + 9 * i;
  bool usable = isfinite(mean[0]) && isfinite(mean[1]) && isfinite(in.splats.opacities[i]);
  for (int k = 0; k < 9; ++k) usable = usable && isfinite(transform[k]);
  for (int k = 0; k < kNormal; ++k) usable = usable && isfinite(in.normals[kNormal * i + k]);
  for (int d = 0; d < in.splats.channels; ++d) usable = usable && isfinite(in.splats.colors[in.splats.channels * i + d]);
  const math::Plane plane = math::plane_of(mean, transform);
  records[i] = math::record_of(mean, plane, in.splats.opacities[i], usable);
  bounds[i] = faint_record<0>();
  if (!(records[i].l > -INFINITY)) return;
  const Bound b = math::bound_of(mean, plane, in.splats.opacities[i]);
  set_shape(bounds[i], b.x, b.y, b.conic, records[i].l);
}

struct Prepared {
  const Record* records;
  const Bounds* bounds;
};
Prepared prepare(const Inputs& in, CudaScratch& scratch, cudaStream_t stream) {
  Record* const records = scratch.array<Record>(in.splats.count);
  Bounds* const bounds = scratch.array<Bounds>(in.splats.count);
  if (in.splats.count > 0) make_records<<<blocks_for(in.splats.count), kThreads, 0, stream>>>(in, records, bounds);
  return {records, bounds};
}

// Copy the surfel at a list position to shared memory: record, and normal with colours. A surfel that is unusable or whose
// index is out of range reaches no pixel.
template <int V>
__device__ inline void stage(const Inputs& in, const Prepared& surfels, int position, Record& record, Bounds& bounds,
                             float* values) {
  const int id = in.splats.flatten_ids[position];
  const bool known = uint32_t(id) < uint64_t(in.splats.count);
  record = known ? surfels.records[id] : math::unusable_record();
  bounds = known ? surfels.bounds[id] : faint_record<0>();
  const bool usable = known && record.l > -INFINITY;
  const int channels = in.splats.channels;
  for (int k = 0; k < kNormal; ++k) values[k] = usable ? in.normals[int64_t(id) * kNormal + k] : 0;
  for (int d = 0; d < V - kNormal; ++d)
    values[kNormal + d] = usable && d < channels ? in.splats.colors[int64_t(id) * channels + d] : 0;
}

// Return the depth of the window's first surfel, the origin of depths; 0 without one, or if it is not finite.
__device__ inline float reference_depth(const Inputs& in, const Window& w) {
  if (w.begin >= w.end) return 0;
  const int id = in.splats.flatten_ids[w.begin], channels = in.splats.channels;
  if (!(uint32_t(id) < uint64_t(in.splats.count))) return 0;
  const float depth = in.splats.colors[int64_t(id) * channels + channels - 1];
  return isfinite(depth) ? depth : 0;
}

// Window of this block; without surfels if its tile is masked.
__device__ inline Window window_of(const Inputs& in, const Place& place) {
  Window w = place.window(in.splats);
  if (in.splats.masks != nullptr && !in.splats.masks[place.tile]) w.end = w.begin;
  return w;
}

template <int V>
__global__ void __launch_bounds__(kBlockThreads) blend(Inputs in, Prepared surfels, Pixels out) {
  __shared__ Record staged[kBlockThreads];
  __shared__ Bounds staged_bounds[kBlockThreads];
  __shared__ float staged_values[kBlockThreads][V];
  const Place place(in.splats);
  const Window w = window_of(in, place);
  const int lane = threadIdx.x & 31, channels = in.splats.channels;
  const float center_x = float(w.x) + 0.5f, reference = reference_depth(in, w);
  float through[kPixelsEach], distortion[kPixelsEach], depth_sum[kPixelsEach], median[kPixelsEach];
  float sum[kPixelsEach][V];
  int last[kPixelsEach], median_at[kPixelsEach];
  bool open[kPixelsEach];
  for (int p = 0; p < kPixelsEach; ++p) {
    through[p] = 1;
    distortion[p] = depth_sum[p] = median[p] = 0;
    last[p] = median_at[p] = -1;
    open[p] = w.inside[p];
    for (int d = 0; d < V; ++d) sum[p][d] = 0;
  }
  for (int begin = w.begin; begin < w.end; begin += kBlockThreads) {
    if (!__syncthreads_or(open[0] || open[1])) break;
    const int own = begin + int(threadIdx.x);
    if (own < w.end)
      stage<V>(in, surfels, own, staged[threadIdx.x], staged_bounds[threadIdx.x], staged_values[threadIdx.x]);
    else
      staged_bounds[threadIdx.x] = faint_record<0>();
    __syncthreads();
    for (int group = 0; group < kBlockThreads && __any_sync(kAll, open[0] || open[1]); group += 32) {
      unsigned hits =
          __ballot_sync(kAll, reaches(staged_bounds[group + lane], float(w.quadrant_x) + 0.5f, float(w.quadrant_y) + 0.5f));
      for (; hits != 0; hits &= hits - 1) {
        const int i = group + __ffs(int(hits)) - 1;
        const float* const value = staged_values[i];
#pragma unroll
        for (int p = 0; p < kPixelsEach; ++p) {
          const Hit h = math::hit_at(staged[i], center_x, float(w.y[p]) + 0.5f);
          const float power = math::power_of(staged[i], fminf(h.plane, h.screen));
          if (!(open[p] && power >= kLog2AlphaCutoff && h.denominator != 0)) continue;
          const float alpha = exp2_fast(fminf(power, in.splats.alpha.log2_most));
          const float behind = fmaf(-alpha, through[p], through[p]);
          if (!(behind > kMinTransmittance)) {
            open[p] = false;
            continue;
          }
          const float weight = alpha * through[p], own_depth = value[kNormal + channels - 1], depth = own_depth - reference;
#pragma unroll
          for (int d = 0; d < V; ++d) sum[p][d] = fmaf(weight, value[d], sum[p][d]);
          distortion[p] = fmaf(2 * weight, fmaf(depth, 1 - through[p], -depth_sum[p]), distortion[p]);
          depth_sum[p] = fmaf(weight, depth, depth_sum[p]);
          if (through[p] > 0.5f) {
            median[p] = own_depth;
            median_at[p] = begin + i;
          }
          through[p] = behind;
          last[p] = begin + i;
        }
      }
    }
  }
  for (int p = 0; p < kPixelsEach; ++p) {
    if (!w.inside[p]) continue;
    const int64_t pixel = place.pixel(in.splats, w, p);
    out.alphas[pixel] = 1 - through[p];
    for (int k = 0; k < kNormal; ++k) out.normals[pixel * kNormal + k] = sum[p][k];
#pragma unroll
    for (int d = 0; d < V - kNormal; ++d) {
      if (d >= channels) continue;
      const float behind = in.splats.backgrounds != nullptr ? through[p] * in.splats.backgrounds[place.image * channels + d] : 0;
      out.colors[pixel * channels + d] = sum[p][kNormal + d] + behind;
    }
    out.distortions[pixel] = distortion[p];
    out.medians[pixel] = median[p];
    out.depth_sums[pixel] = depth_sum[p];
    out.last[pixel] = last[p];
    out.median_at[pixel] = median_at[p];
  }
}

// Number of sums of a surfel in a window, and the number of passes of 16 values that a warp needs to sum them.
constexpr int sums_of(int values, bool absgrad) { return kMoments + values + (absgrad ? 2 : 0); }
constexpr int passes_of(int sums) { return (sums + 15) / 16; }

// A pixel's state in the backward pass.
template <int V>
struct PixelState {
  float through, behind;                // transmittance in front of the surfels visited so far; sum of w g of those behind
  float alpha, depth_total, depth_sum;  // depth_sum: of the surfels in front
  float v_distortion, v_median;
  int last, median_at;
  float v_values[V];
};

// Add a pixel's terms of a surfel to `v`, and advance the pixel to in front of the surfel.
template <int V, bool kAbs>
__device__ inline void add_terms(const Hit& h, float power, float depth, const float* value, int position,
                                 const AlphaLimit& limit, PixelState<V>& pixel, float* v) {
  const float alpha = exp2_fast(fminf(power, limit.log2_most)), widen = reciprocal(1 - alpha);
  const float through = pixel.through * widen, weight = alpha * through;
  float g = 0;
#pragma unroll
  for (int d = 0; d < V; ++d) {
    g = fmaf(pixel.v_values[d], value[d], g);
    v[kMoments + d] = fmaf(weight, pixel.v_values[d], v[kMoments + d]);
  }
  pixel.depth_sum = fmaf(-weight, depth, pixel.depth_sum);
  const float twice = 2 * pixel.v_distortion, balance = 2 * (1 - through) - pixel.alpha;
  g = fmaf(twice, fmaf(depth, balance, pixel.depth_total - 2 * pixel.depth_sum), g);
  v[kDepthMoment] += fmaf(twice * weight, balance + weight, position == pixel.median_at ? pixel.v_median : 0);
  const float v_alpha = fmaf(through, g, -(pixel.behind * widen));
  pixel.through = through;
  pixel.behind = fmaf(weight, g, pixel.behind);
  // Where alpha is clamped to its maximum, opacity and shape have no gradient.
  const float s = power <= limit.log2_most ? alpha * v_alpha : 0;
  const bool on_plane = h.plane <= h.screen;
  // The values on the plane are used only there; elsewhere the intersection may be infinite.
  const Hit hit = {h.dx,    h.dy,    h.denominator, on_plane ? h.inverse : 0, on_plane ? h.u : 0, on_plane ? h.v : 0,
                   h.plane, h.screen};
  math::add_moments(hit, s, on_plane ? s : 0, v);
  if constexpr (kAbs) {
    const float on_screen = on_plane ? 0 : kScreenFactor * s;
    v[kMoments + V] += fabsf(on_screen * h.dx);
    v[kMoments + V + 1] += fabsf(on_screen * h.dy);
  }
}

// Write the gradient rows of a window's surfels. `rows` holds sums_of(V, kAbs) floats per instance and window.
template <int V, bool kAbs>
__global__ void __launch_bounds__(kBlockThreads) blend_backward(Inputs in, Prepared surfels, PixelGradients from, float* rows) {
  constexpr int kSums = sums_of(V, kAbs), kPasses = passes_of(kSums);
  __shared__ Record staged[kBatch];
  __shared__ Bounds staged_bounds[kBatch];
  __shared__ float staged_values[kBatch][V];
  __shared__ float sums[kWarps][kBatch][16 * kPasses + 1];  // padded against bank conflicts
  const Place place(in.splats);
  const Window w = window_of(in, place);
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32, channels = in.splats.channels;
  const int windows = int(in.splats.windows());
  const float center_x = float(w.x) + 0.5f, reference = reference_depth(in, w);
  const auto row_of = [&](int position) { return rows + (int64_t(position) * windows + place.part) * kSums; };
  PixelState<V> pixels[kPixelsEach];
  for (int p = 0; p < kPixelsEach; ++p) {
    PixelState<V>& s = pixels[p];
    s = {1, 0, 0, 0, 0, 0, 0, -1, -1, {}};
    if (!w.inside[p]) continue;
    const int64_t at = place.pixel(in.splats, w, p);
    s.alpha = from.alphas[at];
    s.through = 1 - s.alpha;
    float v_left = -from.v_alphas[at];
    for (int k = 0; k < kNormal; ++k) s.v_values[k] = from.v_normals[at * kNormal + k];
#pragma unroll
    for (int d = 0; d < V - kNormal; ++d) {
      const float v = d < channels ? from.v_colors[at * channels + d] : 0;
      s.v_values[kNormal + d] = v;
      if (d < channels && in.splats.backgrounds != nullptr)
        v_left = fmaf(v, in.splats.backgrounds[place.image * channels + d], v_left);
    }
    s.behind = s.through * v_left;
    s.depth_total = s.depth_sum = from.depth_sums[at];
    s.v_distortion = from.v_distortions[at];
    s.v_median = from.v_medians[at];
    s.last = from.last[at];
    s.median_at = from.median_at[at];
  }
  const int warp_furthest = __reduce_max_sync(kAll, max(pixels[0].last, pixels[1].last));
  const int furthest = block_furthest(warp_furthest);
  // The rows of a masked tile's instances are set to zero, too.
  const int listed_end = place.window(in.splats).end, end = furthest < w.begin ? w.begin : min(furthest + 1, w.end);
  for (int64_t e = threadIdx.x; e < int64_t(listed_end - end) * kSums; e += kBlockThreads)
    row_of(end + int(e / kSums))[e % kSums] = 0;
  for (int stop = end; stop > w.begin; stop -= kBatch) {
    const int first = max(stop - kBatch, w.begin), count = stop - first;
    __syncthreads();
    if (int(threadIdx.x) < kBatch) {
      if (int(threadIdx.x) < count)
        stage<V>(in, surfels, first + int(threadIdx.x), staged[threadIdx.x], staged_bounds[threadIdx.x],
                 staged_values[threadIdx.x]);
      else
        staged_bounds[threadIdx.x] = faint_record<0>();
    }
    for (int e = threadIdx.x; e < kWarps * kBatch * (16 * kPasses + 1); e += kBlockThreads) (&sums[0][0][0])[e] = 0;
    __syncthreads();
    unsigned hits = __ballot_sync(kAll, first + lane <= warp_furthest &&
                                            reaches(staged_bounds[lane], float(w.quadrant_x) + 0.5f, float(w.quadrant_y) + 0.5f));
    while (hits != 0) {
      const int i = 31 - __clz(int(hits)), position = first + i;
      hits &= ~(1u << i);
      float v[16 * kPasses] = {};
      bool used = false;
#pragma unroll
      for (int p = 0; p < kPixelsEach; ++p) {
        const Hit h = math::hit_at(staged[i], center_x, float(w.y[p]) + 0.5f);
        const float power = math::power_of(staged[i], fminf(h.plane, h.screen));
        if (!(power >= kLog2AlphaCutoff && h.denominator != 0 && position <= pixels[p].last)) continue;
        used = true;
        add_terms<V, kAbs>(h, power, staged_values[i][kNormal + channels - 1] - reference, staged_values[i], position,
                           in.splats.alpha, pixels[p], v);
      }
      if (!__any_sync(kAll, used)) continue;
#pragma unroll
      for (int pass = 0; pass < kPasses; ++pass) {
        const float sum = compositing::warp_sums<8>(v + 16 * pass, lane);
        if ((lane & 1) == 0) sums[warp][i][16 * pass + lane / 2] = sum;
      }
    }
    __syncthreads();
    for (int e = threadIdx.x; e < count * kSums; e += kBlockThreads) {
      const int i = e / kSums, r = e % kSums;
      float total = 0;
      for (int k = 0; k < kWarps; ++k) total += sums[k][i][r];
      row_of(first + i)[r] = total;
    }
  }
}

__global__ void convert_sums(Inputs in, const Record* records, const float* sums, int row_size, InputGradients out) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.splats.count) return;
  const bool usable = records[i].l > -INFINITY;
  const float* const own = sums + i * row_size;
  const int channels = in.splats.channels, values = kNormal + padded_channels(channels);
  float mean[2] = {}, transform[9] = {}, opacity = 0, densify[2] = {};
  if (usable)
    math::surfel_gradients(own, in.splats.means2d + 2 * i, in.transforms + 9 * i, in.splats.opacities[i], mean, transform,
                           &opacity, densify);
  for (int k = 0; k < 2; ++k) out.means2d[2 * i + k] = mean[k], out.densify[2 * i + k] = densify[k];
  for (int k = 0; k < 9; ++k) out.transforms[9 * i + k] = transform[k];
  out.opacities[i] = opacity;
  for (int k = 0; k < kNormal; ++k) out.normals[kNormal * i + k] = usable ? own[kMoments + k] : 0;
  for (int d = 0; d < channels; ++d) {
    const float of_depth = d == channels - 1 ? own[kDepthMoment] : 0;
    out.colors[channels * i + d] = usable ? own[kMoments + kNormal + d] + of_depth : 0;
  }
  if (out.absolute != nullptr)
    for (int r = 0; r < 2; ++r) out.absolute[2 * i + r] = usable ? own[kMoments + values + r] : 0;
}

// Gradient of the backgrounds, with one block per image and channel.
__global__ void sum_backgrounds(Inputs in, PixelGradients from, float* v_backgrounds) {
  __shared__ double sums[kThreads];
  const int64_t channels = in.splats.channels, image = blockIdx.x / channels, d = blockIdx.x % channels;
  const int64_t pixels = int64_t(in.splats.width) * in.splats.height;
  double sum = 0;
  for (int64_t i = image * pixels + threadIdx.x; i < (image + 1) * pixels; i += kThreads)
    sum += double(from.v_colors[i * channels + d]) * (1 - from.alphas[i]);
  sums[threadIdx.x] = sum;
  for (int half = kThreads / 2; half > 0; half /= 2) {
    __syncthreads();
    if (int(threadIdx.x) < half) sums[threadIdx.x] += sums[threadIdx.x + half];
  }
  if (threadIdx.x == 0) v_backgrounds[blockIdx.x] = float(sums[0]);
}

// Call run with the number of values of a surfel: normal and padded colours.
template <class Run>
void with_values(int channels, const Run& run) {
  switch (padded_channels(channels)) {
    case 1: return run(std::integral_constant<int, kNormal + 1>());
    case 3: return run(std::integral_constant<int, kNormal + 3>());
    case 4: return run(std::integral_constant<int, kNormal + 4>());
    case 8: return run(std::integral_constant<int, kNormal + 8>());
    default: return run(std::integral_constant<int, kNormal + kMaxChannels>());
  }
}

}  // namespace

void blend_on_device(const Inputs& in, const Pixels& out, CudaScratch& scratch, cudaStream_t stream) {
  const int64_t blocks = in.splats.tiles() * in.splats.windows();
  if (blocks == 0) return;
  const Prepared surfels = prepare(in, scratch, stream);
  with_values(in.splats.channels, [&](auto values) {
    blend<decltype(values)::value><<<unsigned(blocks), kBlockThreads, 0, stream>>>(in, surfels, out);
  });
}

void blend_backward_on_device(const Inputs& in, const PixelGradients& from, const InputGradients& out, CudaScratch& scratch,
                              cudaStream_t stream) {
  const int64_t windows = in.splats.windows(), blocks = in.splats.tiles() * windows, count = in.splats.count;
  const bool absgrad = out.absolute != nullptr;
  const int row_size = sums_of(kNormal + padded_channels(in.splats.channels), absgrad);
  if (count > 0) {
    const Prepared surfels = prepare(in, scratch, stream);
    float* const rows = scratch.array<float>(in.splats.instances * windows * row_size);
    float* const sums = scratch.array<float>(count * row_size);
    if (blocks > 0)
      with_values(in.splats.channels, [&](auto values) {
        constexpr int V = decltype(values)::value;
        const auto kernel = absgrad ? blend_backward<V, true> : blend_backward<V, false>;
        kernel<<<unsigned(blocks), kBlockThreads, 0, stream>>>(in, surfels, from, rows);
      });
    const Instances instances = compositing::by_splat(in.splats, scratch, stream);
    compositing::sum_rows<<<blocks_for(count * row_size), kThreads, 0, stream>>>(count, instances.positions, instances.ranges,
                                                                                 rows, int(windows), row_size, sums);
    convert_sums<<<blocks_for(count), kThreads, 0, stream>>>(in, surfels.records, sums, row_size, out);
  }
  if (out.backgrounds != nullptr && in.splats.images > 0)
    sum_backgrounds<<<unsigned(in.splats.images * in.splats.channels), kThreads, 0, stream>>>(in, from, out.backgrounds);
}

}  // namespace gsplat::surfel_blending
