// Gradient of the splats from the image's gradient: per tile, back to front, one row of sums per instance; then per
// splat the sum of its rows. Rows are sums over the tile's pixels in a fixed order and are added in instance order, so
// results are bitwise reproducible.
#include "../blending/blend_backward.cuh"
#include "rasterization.h"

namespace gsplat::rasterization {
namespace {

using namespace blending;

constexpr int kChannels = 4;  // red, green, blue, z
constexpr int kRowFloat4s = kSplatFloats / 4;
static_assert(quads_of(shape_size(kChannels, false), kChannels) == kRowFloat4s);
static_assert(quads_of(shape_size(kChannels, true), kChannels) == kRowFloat4s);

// State of a pixel before the backward pass, and dL/d(its channels). The background and the gradient of alpha are
// treated as one more splat behind the last.
__device__ inline Pixel start_pixel(const Scene& scene, const PictureGradient& from, int64_t image, int64_t pixel,
                                    float (&v_color)[kChannels]) {
  const float alpha = from.alphas[pixel], left = 1 - alpha;
  float v_left = from.v_alphas != nullptr ? -from.v_alphas[pixel] : 0;
  if (from.v_image != nullptr) {
    if (scene.channels == 3 && scene.depth) {
      const float4 v = reinterpret_cast<const float4*>(from.v_image)[pixel];
      v_color[0] = v.x, v_color[1] = v.y, v_color[2] = v.z, v_color[3] = v.w;
    } else {
      const float* const v = from.v_image + pixel * scene.image_channels();
      for (int d = 0; d < scene.channels; ++d) v_color[d] = v[d];
      if (scene.depth) v_color[3] = v[scene.channels];
    }
    if (scene.expected) {  // depth = sum / max(alpha, 1e-10)
      v_color[3] /= fmaxf(alpha, 1e-10f);
      if (alpha >= 1e-10f) v_left = fmaf(v_color[3], from.depths[pixel], v_left);
    }
    if (scene.backgrounds != nullptr)
      for (int d = 0; d < scene.channels; ++d) v_left = fmaf(v_color[d], scene.backgrounds[image * scene.channels + d], v_left);
  }
  return {left, left * v_left, from.last[pixel]};
}

// Destination of one gradient row. The absolute sums, if any, are computed in the middle of the row, but stored at its
// end.
template <bool kAbsolute>
struct RowWriter {
  float4* row;

  struct Quad {
    float4* row;
    int index;
    __device__ void operator=(const float4& v) const {
      if (!kAbsolute || index == 0) {
        row[index] = v;
      } else {
        float2* const pairs = reinterpret_cast<float2*>(row);
        pairs[index == 1 ? 2 : 3] = make_float2(v.x, v.y);
        pairs[index == 1 ? 5 : 4] = make_float2(v.z, v.w);
      }
    }
  };
  __device__ Quad operator[](int index) const { return {row, index}; }
};

template <bool kAbsolute>
__global__ void __launch_bounds__(kBlockThreads, 5)
    gradients_of_instances(Scene scene, const Record<kChannels>* records, Lists lists, PictureGradient from, float4* rows) {
  __shared__ BackwardStage<kChannels, kAbsolute> stage;
  const int tiles = int(scene.tiles()), image = int(blockIdx.x) / tiles, tile = int(blockIdx.x) % tiles;
  const int left = tile % scene.tile_width * frame::kTile, top = tile / scene.tile_width * frame::kTile;
  const Window w(lists.begin(blockIdx.x), lists.begin(blockIdx.x + 1), left, top, min(left + frame::kTile, scene.width),
                 min(top + frame::kTile, scene.height));
  Pixel pixels[kPixelsEach];
  float v_color[kPixelsEach][kChannels] = {};
  for (int p = 0; p < kPixelsEach; ++p) {
    pixels[p] = {1, 0, -1};
    const int64_t pixel = (int64_t(image) * scene.height + w.y[p]) * scene.width + w.x;
    if (w.inside[p]) pixels[p] = start_pixel(scene, from, image, pixel, v_color[p]);
  }
  const auto fetch = [&](int position) { return records[lists.flatten_ids[position]]; };
  const auto row = [&](int position) { return RowWriter<kAbsolute>{rows + int64_t(lists.sorted[position]) * kRowFloat4s}; };
  blend_backward<kChannels, kAbsolute, false>(w, fetch, pixels, v_color, v_color, row, stage);
}

__device__ inline float4 plus(const float4& a, const float4& b) {
  return make_float4(a.x + b.x, a.y + b.y, a.z + b.z, a.w + b.w);
}
__device__ inline float4 from_lane_xor(const float4& v, int mask) {
  return make_float4(__shfl_xor_sync(kAll, v.x, mask), __shfl_xor_sync(kAll, v.y, mask), __shfl_xor_sync(kAll, v.z, mask),
                     __shfl_xor_sync(kAll, v.w, mask));
}

// a b - c d without cancellation if the products are nearly equal (Kahan; Jeannerod et al. 2013).
__device__ inline float difference_of_products(float a, float b, float c, float d) {
  const float cd = __fmul_rn(c, d);
  return fmaf(a, b, -cd) + fmaf(-c, d, cd);
}

// Four lanes per splat, each with a float4 of the row. The whole warp sums a splat with very many rows; the order of
// additions depends only on their number.
__global__ void __launch_bounds__(kThreads)
    sums_of_splats(int64_t splats, const int32_t* starts, const float4* rows, SplatSums out) {
  constexpr int kMany = 64;
  const int64_t splat = (int64_t(blockIdx.x) * kThreads + threadIdx.x) / 4;
  const int lane = threadIdx.x & 31, q = min(lane % 4, kRowFloat4s - 1);  // the fourth lane duplicates the third
  const int start = splat < splats ? starts[splat] : 0, count = splat < splats ? starts[splat + 1] - start : 0;
  float4 sum = make_float4(0, 0, 0, 0);
  if (count <= kMany) {
#pragma unroll 4
    for (int i = 0; i < count; ++i) sum = plus(sum, rows[int64_t(start + i) * kRowFloat4s + q]);
  }
  for (unsigned left = __ballot_sync(kAll, count > kMany && lane % 4 == 0); left != 0; left &= left - 1) {
    const int owner = __ffs(int(left)) - 1;
    const int first = __shfl_sync(kAll, start, owner), many = __shfl_sync(kAll, count, owner);
    float4 part = make_float4(0, 0, 0, 0);
#pragma unroll 4
    for (int i = lane / 4; i < many; i += 8) part = plus(part, rows[int64_t(first + i) * kRowFloat4s + q]);
    for (int mask = 4; mask < 32; mask *= 2) part = plus(part, from_lane_xor(part, mask));
    if (lane / 4 == owner / 4) sum = part;
  }
  if (splat >= splats || lane % 4 == 3) return;
  reinterpret_cast<float4*>(out.v_splats)[splat * kRowFloat4s + q] = sum;
  const int64_t row = out.row_of != nullptr ? out.row_of[splat] : splat;
  if (row < 0) return;
  if (q == 0) {
    const float *const conic = out.conics + 3 * row, a = conic[0], b = conic[1], c = conic[2];
    reinterpret_cast<float2*>(out.v_means2d)[row] =
        make_float2(difference_of_products(a, sum.y, -b, sum.z), difference_of_products(b, sum.y, -c, sum.z));
  } else if (q == 2 && out.v_absolute != nullptr) {
    reinterpret_cast<float2*>(out.v_absolute)[row] = make_float2(sum.z, sum.w);
  }
}

}  // namespace

void instance_gradients(const Scene& scene, const float* records, const Lists& lists, const PictureGradient& from, bool absolute,
                        float* rows, cudaStream_t stream) {
  const int64_t tiles = scene.images() * scene.tiles();
  if (tiles == 0) return;
  const auto kernel = absolute ? gradients_of_instances<true> : gradients_of_instances<false>;
  kernel<<<unsigned(tiles), kBlockThreads, 0, stream>>>(scene, reinterpret_cast<const Record<kChannels>*>(records), lists, from,
                                                        reinterpret_cast<float4*>(rows));
}

void splat_gradients(const Scene& scene, const int32_t* splat_starts, const float* rows, const SplatSums& out,
                     cudaStream_t stream) {
  const int64_t splats = scene.images() * scene.gaussians;
  if (splats > 0)
    sums_of_splats<<<blocks_for(4 * splats), kThreads, 0, stream>>>(splats, splat_starts, reinterpret_cast<const float4*>(rows),
                                                                    out);
}

}  // namespace gsplat::rasterization
