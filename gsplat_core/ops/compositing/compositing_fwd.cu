#include "splat_records.cuh"

namespace {

constexpr int kBatch = kBlockThreads;  // splats that are staged at once, one per thread

template <int D>
__global__ void __launch_bounds__(kBlockThreads)
    composite_windows(DeviceCompositing in, const Record<D>* records, DevicePixels out) {
  __shared__ Record<D> staged[kBatch];
  __shared__ int staged_ids[D == 0 ? kBatch : 1];
  Window w(in);
  if (in.masks != nullptr && !in.masks[w.tile]) w.end = w.begin;  // nothing but the background
  const int lane = threadIdx.x & 31;
  const float center_x = float(w.x) + 0.5f, quadrant_x = float(w.quadrant_x) + 0.5f, quadrant_y = float(w.quadrant_y) + 0.5f;
  float center_y[kPixelsEach], through[kPixelsEach], sum[kPixelsEach][D > 0 ? D : 1];
  int last[kPixelsEach];
  bool open[kPixelsEach];
  for (int p = 0; p < kPixelsEach; ++p) {
    center_y[p] = float(w.y[p]) + 0.5f;
    through[p] = 1;
    last[p] = -1;
    open[p] = w.inside[p];
    for (int d = 0; d < D; ++d) sum[p][d] = 0;
    if (D == 0 && w.inside[p])
      for (int d = 0; d < in.channels; ++d) out.colors[w.pixel(in, p) * in.channels + d] = 0;
  }

  bool warp_open = __any_sync(kAll, open[0] || open[1]);
  int id;
  Record<D> next = fetch(in, records, w.begin + threadIdx.x, w.end, id);
  for (int64_t first = w.begin; first < w.end; first += kBatch) {
    // Also keeps the staged splats until every warp is done with them.
    if (!__syncthreads_or(warp_open)) break;
    staged[threadIdx.x] = next;
    if constexpr (D == 0) staged_ids[threadIdx.x] = id;
    __syncthreads();
    next = fetch(in, records, first + kBatch + threadIdx.x, w.end, id);  // on its way meanwhile
    for (int group = 0; group < kBatch && warp_open; group += 32) {
      unsigned hits = __ballot_sync(kAll, reaches(staged[group + lane], quadrant_x, quadrant_y));
      for (; hits != 0; hits &= hits - 1) {
        const int i = group + __ffs(int(hits)) - 1;
        const Record<D>& r = staged[i];
#pragma unroll
        for (int p = 0; p < kPixelsEach; ++p) {
          const float power = falloff(r, center_x, center_y[p]).power;
          if (!(open[p] && power >= kFaintest && power <= r.cap)) continue;
          const float alpha = exp2_fast(fminf(power, kOpaque)), left = fmaf(-alpha, through[p], through[p]);
          if (!(left > kStop)) {
            open[p] = false;
            continue;
          }
          const float weight = alpha * through[p];
          if constexpr (D > 0) {
            for (int d = 0; d < D; ++d) sum[p][d] = fmaf(weight, r.colors[d], sum[p][d]);
          } else {
            const float* const color = in.colors + int64_t(staged_ids[i]) * in.channels;
            float* const to = out.colors + w.pixel(in, p) * in.channels;
            for (int d = 0; d < in.channels; ++d) to[d] = fmaf(weight, color[d], to[d]);
          }
          through[p] = left;
          last[p] = int(first) + i;
        }
      }
      warp_open = __any_sync(kAll, open[0] || open[1]);
    }
  }

  for (int p = 0; p < kPixelsEach; ++p) {
    if (!w.inside[p]) continue;
    const int64_t pixel = w.pixel(in, p);
    out.alphas[pixel] = 1 - through[p];
    out.last[pixel] = last[p];
    const float* const background = in.backgrounds != nullptr ? in.backgrounds + w.image * in.channels : nullptr;
    float* const to = out.colors + pixel * in.channels;
    if constexpr (D > 0) {
      if (background != nullptr)
        for (int d = 0; d < D; ++d) sum[p][d] = fmaf(through[p], background[d], sum[p][d]);
      if constexpr (D == 4) {
        *reinterpret_cast<float4*>(to) = make_float4(sum[p][0], sum[p][1], sum[p][2], sum[p][3]);
      } else {
        for (int d = 0; d < D; ++d) to[d] = sum[p][d];
      }
    } else if (background != nullptr) {
      for (int d = 0; d < in.channels; ++d) to[d] = fmaf(through[p], background[d], to[d]);
    }
  }
}

}  // namespace

void composite_on_device(const DeviceCompositing& in, const DevicePixels& out, CudaScratch& scratch, cudaStream_t stream) {
  const int64_t blocks = in.tiles() * in.windows();
  if (blocks == 0) return;
  with_channels(in.channels, [&](auto channels) {
    constexpr int D = decltype(channels)::value;
    const Record<D>* const records = records_of<D>(in, scratch, stream);
    composite_windows<D><<<unsigned(blocks), kBlockThreads, 0, stream>>>(in, records, out);
  });
}
