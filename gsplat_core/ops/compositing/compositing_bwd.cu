// The gradient of compositing, back to front from the saved transmittance, by the formulas of backward_cpu.cpp.
//
// Every instance (a splat in a window) has a row of its own, the sum over the window's pixels in a fixed order; the rows of a
// splat are summed in the order of the lists. No atomics, so the same bits every time.
#include <cub/device/device_radix_sort.cuh>

#include "splat_records.cuh"

namespace {

constexpr int kBatch = 64;   // splats that are staged at once
constexpr int kValues = 16;  // that a warp sums at once

// A row: the moments, |dL/dx| and |dL/dy| (with absgrad, or for any number of channels), colours; in whole float4s.
constexpr int shape_size(int D, bool absgrad) { return kShapeMoments + (D == 0 || absgrad ? 2 : 0); }
constexpr int quads_of(int shape, int channels) { return (shape + channels + 3) / 4; }

// Sums 2 kHalf values over groups of 4 kHalf lanes with one exchange per value: a lane gives half of its values away, then half
// of the rest. For 16 values lane i of the warp returns the sum of value i / 2.
template <int kHalf>
__device__ inline float warp_sums(float* v, int lane) {
  if constexpr (kHalf == 0) {
    return v[0] + __shfl_xor_sync(kAll, v[0], 1);
  } else {
    const bool upper = (lane & 2 * kHalf) != 0;
#pragma unroll
    for (int i = 0; i < kHalf; ++i) {
      const float low = v[i], high = v[i + kHalf];
      v[i] = (upper ? high : low) + __shfl_xor_sync(kAll, upper ? low : high, 2 * kHalf);
    }
    return warp_sums<kHalf / 2>(v, lane);
  }
}

__device__ inline float block_sum(float value) {
  __shared__ float parts[kWarps];
  for (int offset = 16; offset > 0; offset /= 2) value += __shfl_xor_sync(kAll, value, offset);
  __syncthreads();
  if ((threadIdx.x & 31) == 0) parts[threadIdx.x / 32] = value;
  __syncthreads();
  float sum = 0;
  for (int i = 0; i < kWarps; ++i) sum += parts[i];
  return sum;
}

// One pixel on the way from the back to the front.
struct Pixel {
  float through;  // transmittance in front of the splats seen so far
  float behind;   // sum of w g of what is behind, g = <dL/dcolour, colour>
  int last;
};

// What a splat's gradient needs of a pixel.
struct Blend {
  float alpha, through, widen, weight;
};
__device__ inline Blend blend(const Pixel& pixel, float power) {
  Blend b;
  b.alpha = exp2_fast(fminf(power, kOpaque));
  b.widen = reciprocal(1 - b.alpha);
  b.through = pixel.through * b.widen;
  b.weight = b.alpha * b.through;
  return b;
}

// Adds a pixel's part of the moments and moves the pixel in front of the splat.
template <bool kAbs, int D>
__device__ inline void add_moments(const Record<D>& r, const Falloff& f, const Blend& b, float g, Pixel& pixel, float* v) {
  const float v_alpha = fmaf(b.through, g, -(pixel.behind * b.widen));
  pixel.through = b.through;
  pixel.behind = fmaf(b.weight, g, pixel.behind);
  // A splat at the ceiling of 0.99 passes nothing on to its opacity and shape.
  const float s = f.power <= kOpaque ? b.alpha * v_alpha : 0, sx = s * f.dx, sy = s * f.dy;
  v[0] += s;
  v[1] += sx;
  v[2] += sy;
  v[3] = fmaf(sx, f.dx, v[3]);
  v[4] = fmaf(sx, f.dy, v[4]);
  v[5] = fmaf(sy, f.dy, v[5]);
  if constexpr (kAbs) {
    v[kShapeMoments] += fabsf(-kLn2 * fmaf(2 * r.xyab.z, sx, r.xyab.w * sy));
    v[kShapeMoments + 1] += fabsf(-kLn2 * fmaf(r.xyab.w, sx, 2 * r.c * sy));
  }
}

// Reads the window's pixels; adds up what the background gets. Returns the last position that any of the warp's pixels blended.
__device__ inline int start_pixels(const DeviceCompositing& in, const DeviceGradients& out, const Window& w, Pixel* pixels,
                                   float* background_parts) {
  const float* const background = in.backgrounds != nullptr ? in.backgrounds + w.image * in.channels : nullptr;
  float left[kPixelsEach], v_left[kPixelsEach];
  int furthest = -1;
  for (int p = 0; p < kPixelsEach; ++p) {
    const bool inside = w.inside[p];
    const int64_t pixel = w.pixel(in, p);
    left[p] = inside ? 1 - out.alphas[pixel] : 1;
    v_left[p] = inside ? -out.v_alphas[pixel] : 0;
    pixels[p].last = inside ? out.last[pixel] : -1;
    furthest = max(furthest, pixels[p].last);
  }
  for (int d = 0; background != nullptr && d < in.channels; ++d) {
    float shown = 0;
    for (int p = 0; p < kPixelsEach; ++p) {
      const float v = w.inside[p] ? out.v_colors[w.pixel(in, p) * in.channels + d] : 0;
      shown += v * left[p];
      v_left[p] = fmaf(v, background[d], v_left[p]);
    }
    shown = block_sum(shown);
    if (threadIdx.x == 0) background_parts[int64_t(blockIdx.x) * in.channels + d] = shown;
  }
  for (int p = 0; p < kPixelsEach; ++p) pixels[p].through = left[p], pixels[p].behind = left[p] * v_left[p];
  return __reduce_max_sync(kAll, furthest);
}

__device__ inline int block_furthest(int warp_furthest) {
  __shared__ int most[kWarps];
  if ((threadIdx.x & 31) == 0) most[threadIdx.x / 32] = warp_furthest;
  __syncthreads();
  int furthest = -1;
  for (int i = 0; i < kWarps; ++i) furthest = max(furthest, most[i]);
  return furthest;
}

// The row of an instance in this block's window, among those of all windows of its tile.
__device__ inline int64_t row_of(const DeviceCompositing& in, int64_t position) {
  const int side = (in.tile_size + kWindowSize - 1) / kWindowSize, windows = side * side;
  return position * windows + blockIdx.x % windows;
}

__device__ inline void zero_rows(const DeviceCompositing& in, const Window& w, int64_t first, int quads, float4* rows) {
  for (int64_t e = threadIdx.x; e < (w.end - first) * quads; e += kBlockThreads)
    rows[row_of(in, first + e / quads) * quads + e % quads] = make_float4(0, 0, 0, 0);
}

template <int D, bool kAbs>
__global__ void __launch_bounds__(kBlockThreads, 8)
    backward_windows(DeviceCompositing in, const Record<D>* records, DeviceGradients out, float4* rows, float* background_parts) {
  constexpr int kShape = shape_size(D, kAbs), kQuads = quads_of(kShape, D);
  __shared__ Record<D> staged[kBatch];
  __shared__ float4 sums[kWarps][kBatch][kQuads];
  __shared__ unsigned touched[kWarps][kBatch / 32];
  const Window w(in);
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32;
  Pixel pixels[kPixelsEach];
  const int warp_furthest = start_pixels(in, out, w, pixels, background_parts);
  const int64_t furthest = block_furthest(warp_furthest);
  zero_rows(in, w, furthest < w.begin ? w.begin : furthest + 1, kQuads, rows);
  if (furthest < w.begin || furthest >= w.end) return;

  const float center_x = float(w.x) + 0.5f, quadrant_x = float(w.quadrant_x) + 0.5f, quadrant_y = float(w.quadrant_y) + 0.5f;
  float center_y[kPixelsEach], v_color[kPixelsEach][D];
  for (int p = 0; p < kPixelsEach; ++p) {
    center_y[p] = float(w.y[p]) + 0.5f;
    for (int d = 0; d < D; ++d) v_color[p][d] = w.inside[p] ? out.v_colors[w.pixel(in, p) * D + d] : 0;
  }
  const int64_t end = furthest + 1;
  int64_t first = w.begin + (furthest - w.begin) / kBatch * kBatch;
  int id;
  Record<D> next = faint_record<D>();
  if (threadIdx.x < kBatch) next = fetch(in, records, first + threadIdx.x, end, id);
  for (; first >= w.begin; first -= kBatch) {
    if (threadIdx.x < kBatch) staged[threadIdx.x] = next;
    __syncthreads();
    if (threadIdx.x < kBatch) next = fetch(in, records, first - kBatch + threadIdx.x, end, id);  // on its way meanwhile
    for (int group = kBatch - 32; group >= 0; group -= 32) {
      const bool needed = first + group + lane <= warp_furthest && reaches(staged[group + lane], quadrant_x, quadrant_y);
      unsigned hits = __ballot_sync(kAll, needed), used = 0;
      while (hits != 0) {
        const int bit = 31 - __clz(int(hits)), i = group + bit;
        hits ^= 1u << bit;
        const Record<D>& r = staged[i];
        Falloff f[kPixelsEach];
        bool valid[kPixelsEach], any = false;
        for (int p = 0; p < kPixelsEach; ++p) {
          f[p] = falloff(r, center_x, center_y[p]);
          valid[p] = f[p].power >= kFaintest && f[p].power <= r.cap && first + i <= pixels[p].last;
          any |= valid[p];
        }
        if (!__any_sync(kAll, any)) continue;
        float v[kValues] = {};
#pragma unroll
        for (int p = 0; p < kPixelsEach; ++p) {
          if (!valid[p]) continue;
          const Blend b = blend(pixels[p], f[p].power);
          float g = 0;
          for (int d = 0; d < D; ++d) {
            g = fmaf(v_color[p][d], r.colors[d], g);
            v[kShape + d] = fmaf(b.weight, v_color[p][d], v[kShape + d]);
          }
          add_moments<kAbs>(r, f[p], b, g, pixels[p], v);
        }
        const float sum = warp_sums<kValues / 2>(v, lane);
        if ((lane & 1) == 0 && lane / 2 < 4 * kQuads) reinterpret_cast<float*>(sums[warp][i])[lane / 2] = sum;
        used |= 1u << bit;
      }
      if (lane == 0) touched[warp][group / 32] = used;
    }
    __syncthreads();
    const int count = int(end - first < kBatch ? end - first : kBatch);
    for (int e = threadIdx.x; e < count * kQuads; e += kBlockThreads) {
      const int i = e / kQuads, q = e % kQuads;
      float4 sum = make_float4(0, 0, 0, 0);
      for (int from = 0; from < kWarps; ++from) {
        if ((touched[from][i / 32] >> (i % 32) & 1) == 0) continue;
        const float4 part = sums[from][i][q];
        sum = make_float4(sum.x + part.x, sum.y + part.y, sum.z + part.z, sum.w + part.w);
      }
      rows[row_of(in, first + i) * kQuads + q] = sum;
    }
  }
}

// Any number of channels: the whole block takes one splat at a time, and 16 values of its row at a time.
template <bool kAbs>
__global__ void __launch_bounds__(kBlockThreads)
    backward_windows_of_any(DeviceCompositing in, const Record<0>* records, DeviceGradients out, float4* rows,
                            float* background_parts) {
  constexpr int kShape = shape_size(0, kAbs);
  __shared__ float sums[kWarps][kValues];
  const Window w(in);
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32, quads = quads_of(kShape, in.channels);
  Pixel pixels[kPixelsEach];
  const int64_t furthest = block_furthest(start_pixels(in, out, w, pixels, background_parts));
  zero_rows(in, w, furthest < w.begin ? w.begin : furthest + 1, quads, rows);
  if (furthest < w.begin || furthest >= w.end) return;
  const float center_x = float(w.x) + 0.5f;
  for (int64_t position = furthest; position >= w.begin; --position) {
    int id;
    const Record<0> r = fetch(in, records, position, w.end, id);
    const float* const color = in.colors + int64_t(id) * in.channels;
    float shape[kShape] = {}, weight[kPixelsEach] = {};
    for (int p = 0; p < kPixelsEach; ++p) {
      const Falloff f = falloff(r, center_x, float(w.y[p]) + 0.5f);
      if (!(f.power >= kFaintest && f.power <= r.cap && position <= pixels[p].last)) continue;
      const Blend b = blend(pixels[p], f.power);
      const float* const v_color = out.v_colors + w.pixel(in, p) * in.channels;
      float g = 0;
      for (int d = 0; d < in.channels; ++d) g = fmaf(v_color[d], color[d], g);
      weight[p] = b.weight;
      add_moments<kAbs>(r, f, b, g, pixels[p], shape);
    }
    for (int base = 0; base < 4 * quads; base += kValues) {
      float v[kValues] = {};
#pragma unroll
      for (int i = 0; i < kValues; ++i) {
        const int d = base + i - kShape;
        if (base == 0 && i < kShape) {
          v[i] = shape[i < kShape ? i : 0];
        } else if (d < in.channels) {
          for (int p = 0; p < kPixelsEach; ++p)
            if (weight[p] > 0) v[i] = fmaf(weight[p], out.v_colors[w.pixel(in, p) * in.channels + d], v[i]);
        }
      }
      const float sum = warp_sums<kValues / 2>(v, lane);
      if ((lane & 1) == 0) sums[warp][lane / 2] = sum;
      __syncthreads();
      if (threadIdx.x < kValues && base + int(threadIdx.x) < 4 * quads) {
        float all = 0;
        for (int from = 0; from < kWarps; ++from) all += sums[from][threadIdx.x];
        reinterpret_cast<float*>(rows + row_of(in, position) * quads)[base + threadIdx.x] = all;
      }
      __syncthreads();
    }
  }
}

__global__ void number_instances(DeviceCompositing in, uint32_t* splats, uint32_t* positions) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.instances) return;
  const uint32_t id = uint32_t(in.flatten_ids[i]);
  splats[i] = id < uint64_t(in.count) ? id : uint32_t(in.count);
  positions[i] = uint32_t(i);
}

// Where the instances of each splat are, sorted by splat: [x, y). Splats without any keep what is there, zeros.
__global__ void ranges_of_splats(DeviceCompositing in, const uint32_t* sorted, uint2* ranges) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.instances || sorted[i] >= in.count) return;
  if (i == 0 || sorted[i - 1] != sorted[i]) ranges[sorted[i]].x = uint32_t(i);
  if (i + 1 == in.instances || sorted[i + 1] != sorted[i]) ranges[sorted[i]].y = uint32_t(i + 1);
}

__device__ inline float4 plus(const float4& a, const float4& b) {
  return make_float4(a.x + b.x, a.y + b.y, a.z + b.z, a.w + b.w);
}
__device__ inline float4 from_lane_xor(const float4& v, int mask) {
  return make_float4(__shfl_xor_sync(kAll, v.x, mask), __shfl_xor_sync(kAll, v.y, mask), __shfl_xor_sync(kAll, v.z, mask),
                     __shfl_xor_sync(kAll, v.w, mask));
}

// Sums the rows of each splat and turns the sums into gradients: four lanes per splat, each a float4 of the row at a time. A
// splat with very many rows is left to the whole warp, in an order that depends on their number alone.
template <int D>
__global__ void gather_rows(DeviceCompositing in, const Record<D>* records, const uint32_t* positions, const uint2* ranges,
                            const float4* rows, int windows, int shape, DeviceGradients out) {
  constexpr int64_t kMany = 64;
  const int64_t splat = (int64_t(blockIdx.x) * kThreads + threadIdx.x) / 4;
  const int lane = threadIdx.x & 31, quads = quads_of(shape, in.channels);
  const bool usable = splat < in.count && records[splat].l > -INFINITY;
  const uint2 range = usable ? ranges[splat] : make_uint2(0, 0);
  const int64_t count = int64_t(range.y - range.x) * windows;
  const auto row = [&](uint32_t first, int64_t i, int q) {
    return windows == 1 ? rows[int64_t(positions[first + i]) * quads + q]
                        : rows[(int64_t(positions[first + i / windows]) * windows + i % windows) * quads + q];
  };
  const unsigned large = __ballot_sync(kAll, count > kMany && lane % 4 == 0);
  for (int first_quad = 0; first_quad < quads; first_quad += 4) {
    const int q = first_quad + lane % 4;
    float4 sum = make_float4(0, 0, 0, 0);
    if (q < quads && count <= kMany) {
#pragma unroll 4
      for (int64_t i = 0; i < count; ++i) sum = plus(sum, row(range.x, i, q));
    }
    for (unsigned left = large; left != 0; left &= left - 1) {
      const int owner = __ffs(int(left)) - 1;
      const uint32_t first = __shfl_sync(kAll, range.x, owner);
      const int64_t many = __shfl_sync(kAll, count, owner);
      float4 part = make_float4(0, 0, 0, 0);
      if (q < quads) {
#pragma unroll 4
        for (int64_t i = lane / 4; i < many; i += 8) part = plus(part, row(first, i, q));
      }
      for (int mask = 4; mask < 32; mask *= 2) part = plus(part, from_lane_xor(part, mask));
      if (lane / 4 == owner / 4) sum = part;
    }
    if (splat >= in.count || q >= quads) continue;
    const float values[4] = {sum.x, sum.y, sum.z, sum.w};
    if (q == 0) {
      const float a = usable ? in.conics[3 * splat] : 0, b = usable ? in.conics[3 * splat + 1] : 0;
      const float c = usable ? in.conics[3 * splat + 2] : 0;
      out.v_means2d[2 * splat] = a * sum.y + b * sum.z;
      out.v_means2d[2 * splat + 1] = b * sum.y + c * sum.z;
      out.v_conics[3 * splat] = -0.5f * sum.w;
      out.v_opacities[splat] = usable ? sum.x / in.opacities[splat] : 0;
    } else if (q == 1) {
      out.v_conics[3 * splat + 1] = -sum.x;
      out.v_conics[3 * splat + 2] = -0.5f * sum.y;
    }
    for (int r = 0; r < 4; ++r) {
      const int at = 4 * q + r;
      if (at >= shape && at < shape + in.channels) out.v_splat_colors[splat * in.channels + at - shape] = values[r];
      if (out.v_absolute != nullptr && at >= kShapeMoments && at < kShapeMoments + 2)
        out.v_absolute[2 * splat + at - kShapeMoments] = values[r];
    }
  }
}

// One block per image and channel.
__global__ void sum_backgrounds(const float* parts, int64_t parts_per_image, int channels, float* v_backgrounds) {
  __shared__ double sums[kThreads];
  const int64_t image = blockIdx.x / channels, d = blockIdx.x % channels;
  double sum = 0;
  for (int64_t i = threadIdx.x; i < parts_per_image; i += kThreads) sum += parts[(image * parts_per_image + i) * channels + d];
  sums[threadIdx.x] = sum;
  for (int half = kThreads / 2; half > 0; half /= 2) {
    __syncthreads();
    if (int(threadIdx.x) < half) sums[threadIdx.x] += sums[threadIdx.x + half];
  }
  if (threadIdx.x == 0) v_backgrounds[blockIdx.x] = float(sums[0]);
}

// The instances of each splat: their positions, sorted by splat, and where each splat's start and end.
struct Instances {
  const uint32_t* positions;
  const uint2* ranges;
};
Instances by_splat(const DeviceCompositing& in, CudaScratch& scratch, cudaStream_t stream) {
  uint2* const ranges = scratch.array<uint2>(in.count);
  cudaMemsetAsync(ranges, 0, size_t(in.count) * sizeof(uint2), stream);
  if (in.instances == 0) return {nullptr, ranges};
  const auto array = [&] { return scratch.array<uint32_t>(in.instances); };
  cub::DoubleBuffer<uint32_t> splats(array(), array()), positions(array(), array());
  number_instances<<<blocks_for(in.instances), kThreads, 0, stream>>>(in, splats.Current(), positions.Current());
  const int bits = bits_below(in.count + 1);
  size_t size = 0;
  cub::DeviceRadixSort::SortPairs(nullptr, size, splats, positions, in.instances, 0, bits, stream);
  cub::DeviceRadixSort::SortPairs(scratch.bytes(size), size, splats, positions, in.instances, 0, bits, stream);
  ranges_of_splats<<<blocks_for(in.instances), kThreads, 0, stream>>>(in, splats.Current(), ranges);
  return {positions.Current(), ranges};
}

template <int D, bool kAbs>
void run_backward(const DeviceCompositing& in, const DeviceGradients& out, CudaScratch& scratch, cudaStream_t stream) {
  const int64_t windows = in.windows(), blocks = in.tiles() * windows;
  const int shape = shape_size(D, kAbs), quads = quads_of(shape, in.channels);
  const Record<D>* const records = records_of<D>(in, scratch, stream);
  float4* const rows = scratch.array<float4>(in.instances * windows * quads);
  float* const parts = out.v_backgrounds != nullptr ? scratch.array<float>(blocks * in.channels) : nullptr;
  if (blocks > 0) {
    if constexpr (D > 0) {
      backward_windows<D, kAbs><<<unsigned(blocks), kBlockThreads, 0, stream>>>(in, records, out, rows, parts);
    } else {
      backward_windows_of_any<kAbs><<<unsigned(blocks), kBlockThreads, 0, stream>>>(in, records, out, rows, parts);
    }
  }
  if (in.count > 0) {
    const Instances instances = by_splat(in, scratch, stream);
    gather_rows<D><<<blocks_for(4 * in.count), kThreads, 0, stream>>>(in, records, instances.positions, instances.ranges, rows,
                                                                      int(windows), shape, out);
  }
  if (parts != nullptr && in.images > 0 && in.channels > 0)
    sum_backgrounds<<<unsigned(in.images * in.channels), kThreads, 0, stream>>>(parts, blocks / in.images, in.channels,
                                                                                out.v_backgrounds);
}

}  // namespace

void composite_backward_on_device(const DeviceCompositing& in, const DeviceGradients& out, CudaScratch& scratch,
                                  cudaStream_t stream) {
  with_channels(in.channels, [&](auto channels) {
    constexpr int D = decltype(channels)::value;
    if (out.v_absolute != nullptr) {
      run_backward<D, true>(in, out, scratch, stream);
    } else {
      run_backward<D, false>(in, out, scratch, stream);
    }
  });
}
