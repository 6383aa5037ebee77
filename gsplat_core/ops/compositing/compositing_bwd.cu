// Gradient of compositing, traversed back to front from the saved transmittance.
//
// Every instance (a splat in a window) has its own gradient row, the sum over the window's pixels in a fixed order. A
// splat's rows are summed in list order. There are no atomics, so results are bitwise reproducible.
#include "gather_rows.cuh"
#include "warp_sums.cuh"

namespace gsplat::compositing {
namespace {

constexpr int kValues = 16;  // values that a warp sums per pass

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

// Read the window's pixels, and sum the gradient of the background.
__device__ inline void start_pixels(const Inputs& in, const PictureGradient& from, const Place& place, const Window& w,
                                    Pixel (&pixels)[kPixelsEach], float* background_parts) {
  const float* const background = in.backgrounds != nullptr ? in.backgrounds + place.image * in.channels : nullptr;
  float left[kPixelsEach], v_left[kPixelsEach];
  for (int p = 0; p < kPixelsEach; ++p) {
    const bool inside = w.inside[p];
    const int64_t pixel = place.pixel(in, w, p);
    left[p] = inside ? 1 - from.alphas[pixel] : 1;
    v_left[p] = inside ? -from.v_alphas[pixel] : 0;
    pixels[p].last = inside ? from.last[pixel] : -1;
  }
  for (int d = 0; background != nullptr && d < in.channels; ++d) {
    float shown = 0;
    for (int p = 0; p < kPixelsEach; ++p) {
      const float v = w.inside[p] ? from.v_colors[place.pixel(in, w, p) * in.channels + d] : 0;
      shown += v * left[p];
      v_left[p] = fmaf(v, background[d], v_left[p]);
    }
    shown = block_sum(shown);
    if (threadIdx.x == 0) background_parts[int64_t(blockIdx.x) * in.channels + d] = shown;
  }
  for (int p = 0; p < kPixelsEach; ++p) pixels[p].through = left[p], pixels[p].behind = left[p] * v_left[p];
}

// Return the row of an instance for this block's window. Each instance has one row per window of its tile, contiguous.
__device__ inline int64_t row_of(const Inputs& in, int64_t position) {
  const int side = (in.tile_size + kWindow - 1) / kWindow, windows = side * side;
  return position * windows + blockIdx.x % windows;
}

template <int D, bool kAbs>
__global__ void __launch_bounds__(kBlockThreads, 5)
    backward_windows(Inputs in, const Record<D>* records, PictureGradient from, float4* rows, float* background_parts) {
  __shared__ BackwardStage<D, kAbs> stage;
  const Place place(in);
  const Window w = place.window(in);
  Pixel pixels[kPixelsEach];
  start_pixels(in, from, place, w, pixels, background_parts);
  float v_color[kPixelsEach][D];
  for (int p = 0; p < kPixelsEach; ++p)
    for (int d = 0; d < D; ++d) v_color[p][d] = w.inside[p] ? from.v_colors[place.pixel(in, w, p) * D + d] : 0;
  const auto fetch = [&](int position) { return record_at(in, records, position); };
  const auto row = [&](int position) { return rows + row_of(in, position) * stage.kQuads; };
  blend_backward<D, kAbs, true>(w, fetch, pixels, v_color, v_color, row, stage, in.alpha);
}

// A pixel's values that a splat's gradient depends on.
struct Blend {
  float alpha, through, widen, weight;
};
__device__ inline Blend blend(const Pixel& pixel, float power, const AlphaLimit& limit) {
  Blend b;
  b.alpha = exp2_fast(fminf(power, limit.log2_most));
  b.widen = reciprocal(1 - b.alpha);
  b.through = pixel.through * b.widen;
  b.weight = b.alpha * b.through;
  return b;
}

// Add a pixel's s = alpha dL/dalpha times 1, dx, dy, dx^2, dx dy and dy^2 to `v`; advance the pixel to in front of the splat.
template <bool kAbs, int D>
__device__ inline void add_moments(const Record<D>& r, const Falloff& f, const Blend& b, float g, const AlphaLimit& limit,
                                   Pixel& pixel, float* v) {
  const float v_alpha = fmaf(b.through, g, -(pixel.behind * b.widen));
  pixel.through = b.through;
  pixel.behind = fmaf(b.weight, g, pixel.behind);
  // Where alpha is clamped to its maximum, opacity and shape have no gradient.
  const float s = f.power <= limit.log2_most ? b.alpha * v_alpha : 0, sx = s * f.dx, sy = s * f.dy;
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

// Gradient rows for any number of channels: the whole block processes one splat at a time, and 16 values of its row at
// a time.
template <bool kAbs>
__global__ void __launch_bounds__(kBlockThreads)
    backward_windows_of_any(Inputs in, const Record<0>* records, PictureGradient from, float4* rows, float* background_parts) {
  constexpr int kShape = shape_size(0, kAbs);
  __shared__ float sums[kWarps][kValues];
  const Place place(in);
  const Window w = place.window(in);
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32, quads = quads_of(kShape, in.channels);
  Pixel pixels[kPixelsEach];
  start_pixels(in, from, place, w, pixels, background_parts);
  const int furthest = block_furthest(__reduce_max_sync(kAll, max(pixels[0].last, pixels[1].last)));
  const int end = furthest < w.begin ? w.begin : min(furthest + 1, w.end);
  for (int64_t e = threadIdx.x; e < int64_t(w.end - end) * quads; e += kBlockThreads)
    rows[row_of(in, end + e / quads) * quads + e % quads] = make_float4(0, 0, 0, 0);
  const float center_x = float(w.x) + 0.5f;
  for (int position = end - 1; position >= w.begin; --position) {
    const Record<0> r = record_at(in, records, position);
    const float* const color = in.colors + int64_t(in.flatten_ids[position]) * in.channels;
    float shape[kShape] = {}, weight[kPixelsEach] = {};
    for (int p = 0; p < kPixelsEach; ++p) {
      const Falloff f = falloff(r, center_x, float(w.y[p]) + 0.5f);
      if (!(f.power >= kLog2AlphaCutoff && f.power <= r.cap && position <= pixels[p].last)) continue;
      const Blend b = blend(pixels[p], f.power, in.alpha);
      const float* const v_color = from.v_colors + place.pixel(in, w, p) * in.channels;
      float g = 0;
      for (int d = 0; d < in.channels; ++d) g = fmaf(v_color[d], color[d], g);
      weight[p] = b.weight;
      add_moments<kAbs>(r, f, b, g, in.alpha, pixels[p], shape);
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
            if (weight[p] > 0) v[i] = fmaf(weight[p], from.v_colors[place.pixel(in, w, p) * in.channels + d], v[i]);
        }
      }
      const float sum = warp_sums<kValues / 2>(v, lane);
      if ((lane & 1) == 0) sums[warp][lane / 2] = sum;
      __syncthreads();
      if (threadIdx.x < kValues && base + int(threadIdx.x) < 4 * quads) {
        float all = 0;
        for (int warp_index = 0; warp_index < kWarps; ++warp_index) all += sums[warp_index][threadIdx.x];
        reinterpret_cast<float*>(rows + row_of(in, position) * quads)[base + threadIdx.x] = all;
      }
      __syncthreads();
    }
  }
}

// Sum the partial gradients of the backgrounds, with one block per image and channel.
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

template <int D, bool kAbs>
void run_backward(const Inputs& in, const PictureGradient& from, const InputGradients& out, CudaScratch& scratch,
                  cudaStream_t stream) {
  const int64_t windows = in.windows(), blocks = in.tiles() * windows;
  const int shape = shape_size(D, kAbs), quads = quads_of(shape, in.channels);
  const Record<D>* const records = records_of<D>(in, scratch, stream);
  float4* const rows = scratch.array<float4>(in.instances * windows * quads);
  float* const parts = out.backgrounds != nullptr ? scratch.array<float>(blocks * in.channels) : nullptr;
  if (blocks > 0) {
    if constexpr (D > 0) {
      backward_windows<D, kAbs><<<unsigned(blocks), kBlockThreads, 0, stream>>>(in, records, from, rows, parts);
    } else {
      backward_windows_of_any<kAbs><<<unsigned(blocks), kBlockThreads, 0, stream>>>(in, records, from, rows, parts);
    }
  }
  if (in.count > 0) {
    const Instances instances = by_splat(in, scratch, stream);
    gather_rows<D><<<blocks_for(4 * in.count), kThreads, 0, stream>>>(in, records, instances.positions, instances.ranges, rows,
                                                                      int(windows), shape, out);
  }
  if (parts != nullptr && in.images > 0 && in.channels > 0)
    sum_backgrounds<<<unsigned(in.images * in.channels), kThreads, 0, stream>>>(parts, blocks / in.images, in.channels,
                                                                                out.backgrounds);
}

}  // namespace

void composite_backward_on_device(const Inputs& in, const PictureGradient& from, const InputGradients& out, CudaScratch& scratch,
                                  cudaStream_t stream) {
  with_channels(in.channels, [&](auto channels) {
    constexpr int D = decltype(channels)::value;
    if (out.absolute != nullptr) {
      run_backward<D, true>(in, from, out, scratch, stream);
    } else {
      run_backward<D, false>(in, from, out, scratch, stream);
    }
  });
}

}  // namespace gsplat::compositing
