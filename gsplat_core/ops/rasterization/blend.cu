// CUDA kernels that sort the tile lists and blend the image, for rasterize.
#include "../blending/blend_forward.cuh"
#include "../frame/tile_sort.cuh"
#include "dependent_launch.cuh"
#include "rasterization.h"

namespace gsplat::rasterization {
namespace {

using namespace blending;
using namespace frame;

using Splat = Record<4>;
using Stage = ForwardStage<4>;

// The splats of a tile in depth order; `sorted` holds instance numbers.
struct TileSplats {
  const Splat* records;  // of the tile's image
  const int32_t* instance_splats;
  SortedIds sorted;
  int begin;
  uint32_t last_instance;

  // If the capacity was exceeded, lists also contain numbers of dropped instances.
  __device__ uint32_t instance(int position) const { return min(sorted[position - begin], last_instance); }
  __device__ Splat operator()(int position) const { return records[instance_splats[instance(position)]]; }
};

__device__ inline void write_pixel(const Scene& scene, const Pixels& out, int64_t image, int64_t pixel, float through, float* sum,
                                   int last) {
  const float alpha = 1 - through;
  if (scene.backgrounds != nullptr)
    for (int d = 0; d < scene.channels; ++d) sum[d] = fmaf(through, scene.backgrounds[image * scene.channels + d], sum[d]);
  if (scene.expected) sum[3] /= fmaxf(alpha, 1e-10f);
  out.alphas[pixel] = alpha;
  if (out.last != nullptr) out.last[pixel] = last;
  if (out.depths != nullptr) out.depths[pixel] = sum[3];
  if (scene.channels == 3 && scene.depth) {
    reinterpret_cast<float4*>(out.image)[pixel] = make_float4(sum[0], sum[1], sum[2], sum[3]);
    return;
  }
  float* const to = out.image + pixel * scene.image_channels();
  for (int d = 0; d < scene.channels; ++d) to[d] = sum[d];
  if (scene.depth) to[scene.channels] = sum[3];
}

__global__ void __launch_bounds__(kBlockThreads, 8)
    blend_tiles(Scene scene, Splats splats, Lists lists, int tile_bits, Pixels out) {
  wait_for_preceding_kernel();
  __shared__ BlendShared<Stage> shared;
  const int tiles = int(scene.tiles()), image = int(blockIdx.x) / tiles, tile = int(blockIdx.x) % tiles;
  const int begin = lists.begin_within_capacity(blockIdx.x), end = lists.begin_within_capacity(blockIdx.x + 1);
  const SortedIds sorted = sort_tile(lists.keys + begin, end - begin, shared);
  const int64_t first_splat = image * scene.gaussians;
  const Splat* const records = reinterpret_cast<const Splat*>(splats.records) + first_splat;
  const TileSplats of_tile = {records, lists.instance_splats, sorted, begin, uint32_t(lists.capacity) - 1};
  for (int i = threadIdx.x; i < end - begin; i += kBlockThreads) {
    const uint32_t instance = of_tile.instance(begin + i);
    const int32_t splat = lists.instance_splats[instance];
    if (lists.sorted != nullptr) lists.sorted[begin + i] = int32_t(instance);
    lists.flatten_ids[begin + i] = int32_t(first_splat + splat);
    lists.isect_ids[begin + i] =
        int64_t(image) << (32 + tile_bits) | int64_t(tile) << 32 | int64_t(__float_as_uint(splats.depths[first_splat + splat]));
  }
  const int left = tile % scene.tile_width * frame::kTile, top = tile / scene.tile_width * frame::kTile;
  const Window w(begin, end, left, top, min(left + frame::kTile, scene.width), min(top + frame::kTile, scene.height));
  BlendedPixels<4> pixels = blend_forward<4, false, true>(w, of_tile, shared.stage);
  for (int p = 0; p < kPixelsEach; ++p) {
    if (!w.inside[p]) continue;
    const int64_t pixel = (int64_t(image) * scene.height + w.y[p]) * scene.width + w.x;
    write_pixel(scene, out, image, pixel, pixels.through[p], pixels.sum[p], pixels.last[p]);
  }
}

// Return the scene in the format of render_frame's kernels, for the tile lists of one image, or of all images.
frame::Scene frame_of(const Scene& scene, int64_t count, int64_t tile_rows) {
  frame::Scene of_frame = {};
  of_frame.count = count;
  of_frame.width = scene.width;
  of_frame.height = scene.height;
  of_frame.tile_width = scene.tile_width;
  of_frame.tile_height = int32_t(tile_rows);
  return of_frame;
}

}  // namespace

void scan(const Scene& scene, const Lists& lists, int32_t* status, const frame::Scratch& scratch, cudaStream_t stream) {
  frame::Lists frame_lists = {};
  frame_lists.tile_offsets = lists.tile_offsets;
  frame_lists.status = status;
  frame_lists.capacity = (int64_t(1) << 31) - 1;
  // The tiles of all images are stacked vertically. The number of Gaussians is padded to whole blocks, so that each
  // block belongs to one image.
  frame::scan(frame_of(scene, scene.images() * scene.blocks() * frame::kGaussianThreads, scene.images() * scene.tile_height),
              frame_lists, scratch, stream);
}

void fill(const Scene& scene, const Splats& splats, const Lists& lists, const frame::Scratch& scratch, cudaStream_t stream) {
  for (int64_t image = 0; image < scene.images(); ++image) {
    const int64_t first = image * scene.gaussians;
    frame::Lists frame_lists = {};
    frame_lists.records = splats.records + first * kSplatFloats;
    frame_lists.tile_offsets = lists.tile_offsets;
    frame_lists.keys = lists.keys;
    frame_lists.splat_starts = lists.splat_starts + first;
    frame_lists.instance_splats = lists.instance_splats;
    frame_lists.capacity = lists.capacity;
    frame::Scratch of_image = scratch;
    of_image.footprints += first;
    of_image.depths += first;
    of_image.counters += image * scene.tiles() * scratch.counter_stride;
    of_image.block_starts += image * scene.blocks();
    frame::fill(frame_of(scene, scene.gaussians, scene.tile_height), frame_lists, of_image, stream);
  }
}

void blend(const Scene& scene, const Splats& splats, const Lists& lists, const Pixels& out, cudaStream_t stream) {
  const int64_t tiles = scene.images() * scene.tiles();
  if (tiles == 0) return;
  // As many bits as gsplat reserves for the tile: floor(log2(tiles)) + 1.
  const int tile_bits = 64 - __builtin_clzll(uint64_t(scene.tiles()));
  launch_dependent(blend_tiles, unsigned(tiles), kBlockThreads, stream, 0, scene, splats, lists, tile_bits, out);
}

}  // namespace gsplat::rasterization
