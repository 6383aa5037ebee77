// CUDA kernel of front-to-back alpha compositing.
#include "../blending/blend_forward.cuh"
#include "composite_windows.cuh"

namespace gsplat::compositing {
namespace {

template <int D>
__device__ inline void write_pixels(const Inputs& in, const Place& place, const Window& w, BlendedPixels<D>& blended,
                                    const Pixels& out) {
  const float* const background = in.backgrounds != nullptr ? in.backgrounds + place.image * in.channels : nullptr;
  for (int p = 0; p < kPixelsEach; ++p) {
    if (!w.inside[p]) continue;
    const int64_t pixel = place.pixel(in, w, p);
    out.alphas[pixel] = 1 - blended.through[p];
    out.last[pixel] = blended.last[p];
    float* const to = out.colors + pixel * D;
    float (&sum)[D] = blended.sum[p];
    if (background != nullptr)
      for (int d = 0; d < D; ++d) sum[d] = fmaf(blended.through[p], background[d], sum[d]);
    if constexpr (D == 4) {
      *reinterpret_cast<float4*>(to) = make_float4(sum[0], sum[1], sum[2], sum[3]);
    } else {
      for (int d = 0; d < D; ++d) to[d] = sum[d];
    }
  }
}

template <int D>
__global__ void __launch_bounds__(kBlockThreads, 8) composite_windows(Inputs in, const Record<D>* records, Pixels out) {
  __shared__ ForwardStage<D> stage;
  const Place place(in);
  Window w = place.window(in);
  if (in.masks != nullptr && !in.masks[place.tile]) w.end = w.begin;  // a masked tile shows only the background
  const auto fetch = [&](int position) { return record_at(in, records, position); };
  BlendedPixels<D> blended = blend_forward<D, true>(w, fetch, stage, in.alpha);
  write_pixels<D>(in, place, w, blended, out);
}

// Blending for any number of channels: the sums are accumulated in the output image.
__global__ void __launch_bounds__(kBlockThreads) composite_windows_of_any(Inputs in, const Record<0>* records, Pixels out) {
  __shared__ Record<0> staged[kBlockThreads];
  __shared__ int staged_ids[kBlockThreads];
  const Place place(in);
  Window w = place.window(in);
  if (in.masks != nullptr && !in.masks[place.tile]) w.end = w.begin;
  const int lane = threadIdx.x & 31;
  const float center_x = float(w.x) + 0.5f;
  float through[kPixelsEach];
  int last[kPixelsEach];
  bool open[kPixelsEach];
  for (int p = 0; p < kPixelsEach; ++p) {
    through[p] = 1;
    last[p] = -1;
    open[p] = w.inside[p];
    for (int d = 0; w.inside[p] && d < in.channels; ++d) out.colors[place.pixel(in, w, p) * in.channels + d] = 0;
  }
  for (int left = w.end - w.begin; left > 0; left -= kBlockThreads) {
    if (!__syncthreads_or(open[0] || open[1])) break;
    const int first = w.end - left;
    const bool has = int(threadIdx.x) < left;
    staged[threadIdx.x] = has ? record_at(in, records, first + int(threadIdx.x)) : faint_record<0>();
    staged_ids[threadIdx.x] = has ? in.flatten_ids[first + int(threadIdx.x)] : 0;
    __syncthreads();
    for (int group = 0; group < kBlockThreads && __any_sync(kAll, open[0] || open[1]); group += 32) {
      unsigned hits = __ballot_sync(kAll, reaches(staged[group + lane], float(w.quadrant_x) + 0.5f, float(w.quadrant_y) + 0.5f));
      for (; hits != 0; hits &= hits - 1) {
        const int i = group + __ffs(int(hits)) - 1;
        for (int p = 0; p < kPixelsEach; ++p) {
          const float power = falloff(staged[i], center_x, float(w.y[p]) + 0.5f).power;
          if (!(open[p] && power >= kLog2AlphaCutoff && power <= staged[i].cap)) continue;
          const float alpha = exp2_fast(fminf(power, in.alpha.log2_most)), behind = fmaf(-alpha, through[p], through[p]);
          if (!(behind > kMinTransmittance)) {
            open[p] = false;
            continue;
          }
          const float weight = alpha * through[p];
          const float* const color = in.colors + int64_t(staged_ids[i]) * in.channels;
          float* const to = out.colors + place.pixel(in, w, p) * in.channels;
          for (int d = 0; d < in.channels; ++d) to[d] = fmaf(weight, color[d], to[d]);
          through[p] = behind;
          last[p] = first + i;
        }
      }
    }
  }
  const float* const background = in.backgrounds != nullptr ? in.backgrounds + place.image * in.channels : nullptr;
  for (int p = 0; p < kPixelsEach; ++p) {
    if (!w.inside[p]) continue;
    const int64_t pixel = place.pixel(in, w, p);
    out.alphas[pixel] = 1 - through[p];
    out.last[pixel] = last[p];
    float* const to = out.colors + pixel * in.channels;
    for (int d = 0; background != nullptr && d < in.channels; ++d) to[d] = fmaf(through[p], background[d], to[d]);
  }
}

}  // namespace

void composite_on_device(const Inputs& in, const Pixels& out, CudaScratch& scratch, cudaStream_t stream) {
  const int64_t blocks = in.tiles() * in.windows();
  if (blocks == 0) return;
  with_channels(in.channels, [&](auto channels) {
    constexpr int D = decltype(channels)::value;
    const Record<D>* const records = records_of<D>(in, scratch, stream);
    if constexpr (D > 0) {
      composite_windows<D><<<unsigned(blocks), kBlockThreads, 0, stream>>>(in, records, out);
    } else {
      composite_windows_of_any<<<unsigned(blocks), kBlockThreads, 0, stream>>>(in, records, out);
    }
  });
}

}  // namespace gsplat::compositing
