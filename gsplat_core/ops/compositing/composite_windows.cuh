// Records and windows of the op composite, for its forward and backward kernels.
#pragma once

#include <type_traits>

#include "../blending/splats.cuh"
#include "compositing.h"
#include "cuda_scratch.h"

namespace gsplat::compositing {
namespace {

using namespace blending;

template <int D>
__global__ void make_records(Inputs in, Record<D>* records) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.count) return;
  const float x = in.means2d[2 * i], y = in.means2d[2 * i + 1], opacity = in.opacities[i];
  const float conic[3] = {in.conics[3 * i], in.conics[3 * i + 1], in.conics[3 * i + 2]}, a = conic[0], b = conic[1], c = conic[2];
  Record<D> r = {};
  bool usable = isfinite(x) && isfinite(y) && isfinite(a) && isfinite(b) && isfinite(c) && isfinite(opacity);
  if constexpr (D > 0) {
    for (int d = 0; d < D; ++d) {
      r.colors[d] = in.colors[D * i + d];
      usable = usable && isfinite(r.colors[d]);
    }
  } else {
    for (int d = 0; d < in.channels; ++d) usable = usable && isfinite(in.colors[in.channels * i + d]);
  }
  if (!usable) {
    r = faint_record<D>();
  } else {
    const float log2_opacity = opacity > 0 ? log2f(opacity) : -INFINITY;
    set_shape(r, x, y, conic, log2_opacity, a >= 0 && c >= 0 && a * c - b * b >= 0 ? INFINITY : log2_opacity);
  }
  records[i] = r;
}

template <int D>
Record<D>* records_of(const Inputs& in, CudaScratch& scratch, cudaStream_t stream) {
  Record<D>* const records = scratch.array<Record<D>>(in.count);
  if (in.count > 0) make_records<D><<<blocks_for(in.count), kThreads, 0, stream>>>(in, records);
  return records;
}

// Record of the splat at a list position. The lists are caller input: an index out of range is read as a splat that
// reaches no pixel.
template <int D>
__device__ inline Record<D> record_at(const Inputs& in, const Record<D>* records, int position) {
  const int id = in.flatten_ids[position];
  return uint32_t(id) < uint64_t(in.count) ? records[id] : faint_record<D>();
}

// Window, tile and image that this block composites.
struct Place {
  int64_t tile, image;
  int side, part;  // windows per tile side, and the index of the block's window

  __device__ explicit Place(const Inputs& in) {
    side = (in.tile_size + kWindow - 1) / kWindow;
    tile = blockIdx.x / (side * side);
    part = int(blockIdx.x % (side * side));
    image = tile / (int64_t(in.tile_width) * in.tile_height);
  }
  __device__ Window window(const Inputs& in) const {
    const int64_t tiles = int64_t(in.tile_width) * in.tile_height;
    const int64_t begin = clamp(in.offsets[tile], in.instances);
    const int64_t end = tile + 1 < tiles * in.images ? clamp(in.offsets[tile + 1], in.instances) : in.instances;
    const int within = int(tile % tiles);
    const int tile_x = within % in.tile_width * in.tile_size, tile_y = within / in.tile_width * in.tile_size;
    const int right = min(tile_x + in.tile_size, in.width), bottom = min(tile_y + in.tile_size, in.height);
    const int left = tile_x + part % side * kWindow, top = tile_y + part / side * kWindow;
    return Window(int(begin), int(end), left, top, right, bottom);
  }
  __device__ int64_t pixel(const Inputs& in, const Window& w, int p) const {
    return (image * in.height + w.y[p]) * in.width + w.x;
  }
  __device__ static int64_t clamp(int64_t value, int64_t most) { return value < 0 ? 0 : value > most ? most : value; }
};

// Call run with the number of channels as a constant; 0 for numbers without a compiled specialisation.
template <class Run>
void with_channels(int channels, const Run& run) {
  switch (channels) {
    case 1: return run(std::integral_constant<int, 1>());
    case 3: return run(std::integral_constant<int, 3>());
    case 4: return run(std::integral_constant<int, 4>());
    case 5: return run(std::integral_constant<int, 5>());
    default: return run(std::integral_constant<int, 0>());
  }
}

}  // namespace

}  // namespace gsplat::compositing
