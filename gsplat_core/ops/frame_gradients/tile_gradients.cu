// Gradient of compositing: per tile, back to front, one row of sums per instance.
//
// A row is the sum over the tile's pixels in a fixed order. Unless `atomic`, every instance has its own row and there
// are no atomic additions, so results are bitwise reproducible.
#include "../blending/blend_backward.cuh"
#include "cuda_check.h"
#include "frame_gradients.h"

namespace gsplat::frame {
namespace {

using namespace blending;

constexpr int kChannels = 4;  // red, green, blue, z
static_assert(quads_of(shape_size(kChannels, false), kChannels) == kRowQuads);

// State of a pixel behind its last splat, and dL/d(pixel colour). The background is treated as a layer behind all
// splats, with its contribution to dL/dalpha.
__device__ inline Pixel start_pixel(const Scene& scene, const PictureGradient& from, int x, int y, float (&v_color)[kChannels]) {
  const int64_t at = int64_t(y) * scene.width + x;
  const float4 v = reinterpret_cast<const float4*>(from.v_image)[at];
  v_color[0] = v.x, v_color[1] = v.y, v_color[2] = v.z, v_color[3] = v.w;
  const float left = 1 - from.alphas[at];
  float v_left = from.v_alphas != nullptr ? -from.v_alphas[at] : 0;
  if (scene.background != nullptr)
    for (int d = 0; d < 3; ++d) v_left = fmaf(v_color[d], scene.background[d], v_left);
  return {left, left * v_left, from.last[at]};
}

// A splat's row to which several tiles add with atomics; has the interface of an array of float4.
struct AtomicRow {
  float4* row;

  struct Quad {
    float4* at;
    __device__ void operator=(const float4& v) const {
      if (v.x == 0 && v.y == 0 && v.z == 0 && v.w == 0) return;
#if __CUDA_ARCH__ >= 900
      asm volatile("red.global.add.v4.f32 [%0], {%1, %2, %3, %4};" ::"l"(at), "f"(v.x), "f"(v.y), "f"(v.z), "f"(v.w) : "memory");
#else
      atomicAdd(&at->x, v.x);
      atomicAdd(&at->y, v.y);
      atomicAdd(&at->z, v.z);
      atomicAdd(&at->w, v.w);
#endif
    }
  };
  __device__ Quad operator[](int q) const { return {row + q}; }
};

template <bool kAtomic>
__global__ void __launch_bounds__(kBlockThreads, 5) backward_tiles(Scene scene, Lists lists, PictureGradient from) {
  __shared__ BackwardStage<kChannels, false> stage;
  if (lists.status[kStatusOverflow] != 0) return;
  const int tile = blockIdx.x, left = tile % scene.tile_width * kTile, top = tile / scene.tile_width * kTile;
  const Window w(lists.tile_offsets[tile], lists.tile_offsets[tile + 1], left, top, min(left + kTile, scene.width),
                 min(top + kTile, scene.height));
  Pixel pixels[kPixelsEach];
  float v_color[kPixelsEach][kChannels] = {}, summed[kPixelsEach][kChannels] = {};
  for (int p = 0; p < kPixelsEach; ++p) {
    pixels[p] = {1, 0, -1};
    if (w.inside[p]) pixels[p] = start_pixel(scene, from, w.x, w.y[p], v_color[p]);
    for (int d = 0; d < kChannels; ++d) summed[p][d] = v_color[p][d];
    if (from.correction.residuals != nullptr && w.inside[p]) {
      const int64_t at = int64_t(w.y[p]) * scene.width + w.x;
      const float4 r = reinterpret_cast<const float4*>(from.correction.residuals)[at];
      summed[p][0] = r.x, summed[p][1] = r.y, summed[p][2] = r.z, summed[p][3] = r.w;
    }
  }
  const auto* const records = static_cast<const Record<kChannels>*>(lists.records);
  const auto fetch = [&](int position) { return records[lists.instance_splats[lists.sorted[position]]]; };
  if constexpr (kAtomic) {
    const auto row = [&](int position) {
      return AtomicRow{from.rows + int64_t(lists.instance_splats[lists.sorted[position]]) * kRowQuads};
    };
    blend_backward<kChannels, false, false>(w, fetch, pixels, v_color, summed, row, stage);
  } else {
    const auto row = [&](int position) { return from.rows + int64_t(lists.sorted[position]) * kRowQuads; };
    blend_backward<kChannels, false, false>(w, fetch, pixels, v_color, summed, row, stage);
  }
}

}  // namespace

void tile_gradients(const Scene& scene, const Lists& lists, const PictureGradient& from, cudaStream_t stream) {
  if (from.atomic)
    check_cuda(cudaMemsetAsync(from.rows, 0, size_t(scene.count) * kRowQuads * sizeof(float4), stream), "clearing gradient rows");
  if (scene.tiles() == 0) return;
  const auto kernel = from.atomic ? backward_tiles<true> : backward_tiles<false>;
  kernel<<<unsigned(scene.tiles()), kBlockThreads, 0, stream>>>(scene, lists, from);
}

}  // namespace gsplat::frame
