#include "world_blending.h"

#include "cuda_scratch.h"
#include "world_blending_math.h"

namespace gsplat::world_blending {
namespace {

using namespace GSPLAT_ISA::world_blending;

constexpr int kSide = 16;               // pixels per side of a thread block
constexpr int kChannelsAtOnce = 8;      // in registers; further ones repeat the pass over the list
constexpr int kStaged = kSide * kSide;  // Gaussians in shared memory

// Blend the Gaussians of a tile. A thread has one pixel. The threads of a block stage the Gaussians of their tile in
// shared memory.
__global__ void __launch_bounds__(kStaged) blend(Inputs in, Pixels out, int first_channel) {
  __shared__ float staged[kStaged][kGaussianNumbers + 1];
  __shared__ int32_t ids[kStaged];
  const int across = (in.tile_size + kSide - 1) / kSide, windows = across * across;
  const int64_t tiles = int64_t(in.tile_width) * in.tile_height, tile = blockIdx.x / windows, image = tile / tiles;
  const int window = int(blockIdx.x % windows), place = int(tile % tiles);
  const int in_x = window % across * kSide + int(threadIdx.x) % kSide, in_y = window / across * kSide + int(threadIdx.x) / kSide;
  const int x = place % in.tile_width * in.tile_size + in_x, y = place / in.tile_width * in.tile_size + in_y;
  const bool inside = in_x < in.tile_size && in_y < in.tile_size && x < in.width && y < in.height;
  const int64_t pixel = (image * in.height + y) * in.width + x;
  const bool masked = in.masks != nullptr && !in.masks[tile];
  // The host does not check the lists: clamp positions, and skip ids out of range.
  int64_t begin = in.offsets[tile], end = tile + 1 < tiles * in.images ? in.offsets[tile + 1] : in.instances;
  begin = begin < 0 ? 0 : begin;
  end = masked ? begin : end > in.instances ? in.instances : end;
  float ray[kRayNumbers] = {}, check = 0;
  if (inside)
    for (int k = 0; k < kRayNumbers; ++k) ray[k] = in.rays[pixel * kRayNumbers + k], check += 0.0f * ray[k];
  bool open = inside && check == 0.0f;
  float through = 1, sum[kChannelsAtOnce] = {};
  const int channels = min(in.channels - first_channel, kChannelsAtOnce);
  const float* const gaussians = in.gaussians + image / in.cameras * in.count * kGaussianNumbers;
  for (int64_t first = begin; first < end; first += kStaged) {
    if (__syncthreads_count(open) == 0) break;
    const int64_t mine = first + threadIdx.x;
    int32_t id = mine < end ? in.flatten_ids[mine] : -1;
    if (id < 0 || id >= in.count * in.images) id = -1;
    ids[threadIdx.x] = id;
    for (int k = 0; k < kGaussianNumbers && id >= 0; ++k)
      staged[threadIdx.x][k] = gaussians[int64_t(id) % in.count * kGaussianNumbers + k];
    staged[threadIdx.x][kGaussianNumbers] = id < 0 ? 0 : in.opacities[id];
    __syncthreads();
    const int count = int(end - first < kStaged ? end - first : kStaged);
    for (int i = 0; i < count && open; ++i) {
      if (ids[i] < 0) continue;
      const float* const gaussian = staged[i];
      const float alpha = min(gaussian[kGaussianNumbers] * exp2f(-kHalfLog2E * squared_distance(gaussian, ray)), in.max_alpha);
      if (!(alpha >= gsplat::kAlphaCutoff)) continue;
      const float next = through * (1 - alpha);
      if (!(next > gsplat::kMinTransmittance)) {
        open = false;
        break;
      }
      const float* const color = in.colors + int64_t(ids[i]) * in.channels + first_channel;
      for (int d = 0; d < kChannelsAtOnce; ++d)
        if (d < channels) sum[d] += alpha * through * color[d];
      through = next;
    }
    __syncthreads();
  }
  if (!inside) return;
  if (first_channel == 0) out.through[pixel] = through;
  for (int d = 0; d < kChannelsAtOnce; ++d)
    if (d < channels) out.colors[pixel * in.channels + first_channel + d] = sum[d];
}

}  // namespace

void blend_on_device(const Inputs& in, const Pixels& out, cudaStream_t stream) {
  const int64_t across = (in.tile_size + kSide - 1) / kSide;
  const int64_t blocks = int64_t(in.images) * in.tile_width * in.tile_height * across * across;
  if (blocks == 0) return;
  for (int channel = 0; channel == 0 || channel < in.channels; channel += kChannelsAtOnce)
    blend<<<unsigned(blocks), kStaged, 0, stream>>>(in, out, channel);
}

}  // namespace gsplat::world_blending
