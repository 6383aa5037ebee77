// The lists of the tiles, and the picture.
#include "../compositing/blend_forward.cuh"
#include "../frame/frame_launch.cuh"
#include "../frame/frame_tile_sort.cuh"
#include "rasterization.h"

namespace gsplat::rasterization {
namespace {

using Splat = Record<4>;
using Stage = ForwardStage<4>;

// The splats of a tile in the order of their depth: `sorted` has numbers of instances.
struct TileSplats {
  const Splat* records;  // of the image
  const int32_t* instance_splats;
  SortedNumbers sorted;
  int begin;

  __device__ Splat operator()(int position) const { return records[instance_splats[sorted[position - begin]]]; }
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
  wait_for_kernel_in_front();
  __shared__ BlendRoom<Stage> room;
  const int tiles = int(scene.tiles()), image = int(blockIdx.x) / tiles, tile = int(blockIdx.x) % tiles;
  const int begin = lists.begin(blockIdx.x), end = lists.begin(blockIdx.x + 1);
  const SortedNumbers sorted = sort_tile(lists.keys + begin, end - begin, room);
  const int64_t first_splat = image * scene.gaussians;
  const Splat* const records = reinterpret_cast<const Splat*>(splats.records) + first_splat;
  for (int i = threadIdx.x; i < end - begin; i += kBlockThreads) {
    const uint32_t instance = sorted[i];
    const int32_t splat = lists.instance_splats[instance];
    if (lists.sorted != nullptr) lists.sorted[begin + i] = int32_t(instance);
    lists.flatten_ids[begin + i] = int32_t(first_splat + splat);
    lists.isect_ids[begin + i] =
        int64_t(image) << (32 + tile_bits) | int64_t(tile) << 32 | int64_t(__float_as_uint(splats.depths[first_splat + splat]));
  }
  const int left = tile % scene.tile_width * kFrameTile, top = tile / scene.tile_width * kFrameTile;
  const Window w(begin, end, left, top, min(left + kFrameTile, scene.width), min(top + kFrameTile, scene.height));
  const TileSplats of_tile = {records, lists.instance_splats, sorted, begin};
  BlendedPixels<4> pixels = blend_forward<4, false, true>(w, of_tile, room.stage);
  for (int p = 0; p < kPixelsEach; ++p) {
    if (!w.inside[p]) continue;
    const int64_t pixel = (int64_t(image) * scene.height + w.y[p]) * scene.width + w.x;
    write_pixel(scene, out, image, pixel, pixels.through[p], pixels.sum[p], pixels.last[p]);
  }
}

// The frame path's view of the lists of one image, or of all.
FrameScene frame_of(const Scene& scene, int64_t count, int64_t tile_rows) {
  FrameScene frame = {};
  frame.count = count;
  frame.width = scene.width;
  frame.height = scene.height;
  frame.tile_width = scene.tile_width;
  frame.tile_height = int32_t(tile_rows);
  return frame;
}

}  // namespace

void scan(const Scene& scene, const Lists& lists, int32_t* status, const FrameScratch& scratch, cudaStream_t stream) {
  FrameLists frame = {};
  frame.tile_offsets = lists.tile_offsets;
  frame.status = status;
  frame.capacity = (int64_t(1) << 31) - 1;
  // All images' tiles below one another, and as many Gaussians as there are threads: a block is of one image.
  scan_frame(frame_of(scene, scene.images() * scene.blocks() * kFrameThreads, scene.images() * scene.tile_height), frame, scratch,
             stream);
}

void fill(const Scene& scene, const Splats& splats, const Lists& lists, const FrameScratch& scratch, cudaStream_t stream) {
  for (int64_t image = 0; image < scene.images(); ++image) {
    const int64_t first = image * scene.gaussians;
    FrameLists frame = {};
    frame.records = splats.records + first * kSplatFloats;
    frame.tile_offsets = lists.tile_offsets;
    frame.keys = lists.keys;
    frame.splat_starts = lists.splat_starts + first;
    frame.instance_splats = lists.instance_splats;
    frame.capacity = lists.length;
    FrameScratch of_image = scratch;
    of_image.footprints += first;
    of_image.depths += first;
    of_image.slots += image * scene.tiles() * scratch.slot_stride;
    of_image.starts += image * scene.blocks();
    fill_frame(frame_of(scene, scene.gaussians, scene.tile_height), frame, of_image, stream);
  }
}

void blend(const Scene& scene, const Splats& splats, const Lists& lists, const Pixels& out, cudaStream_t stream) {
  const int64_t tiles = scene.images() * scene.tiles();
  if (tiles == 0) return;
  // As many bits as gsplat gives the tile: floor(log2(tiles)) + 1.
  const int tile_bits = 64 - __builtin_clzll(uint64_t(scene.tiles()));
  launch_behind(blend_tiles, unsigned(tiles), kBlockThreads, stream, 0, scene, splats, lists, tile_bits, out);
}

}  // namespace gsplat::rasterization
