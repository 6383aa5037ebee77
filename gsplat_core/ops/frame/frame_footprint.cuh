// Which tiles a splat of the frame path touches: told by preprocess to fill in eight bytes.
#pragma once

#include "../compositing/blend_window.cuh"
#include "../tiles/tile_ellipse.cuh"
#include "frame_cuda.h"

namespace {

using namespace gsplat::tiles;

// A splat whose box has at most 32 tiles has a bit for each, row by row. Of a larger one the box is kept, and the warp finds its
// tiles together, in every kernel anew, from the record. Nothing touched: both words are 0.
//   small: x = width - 1 (5 bits from 26) | top (13 bits from 13) | left (13 bits), y = the bits
//   large: x = 1 << 31 | top | left,                                                 y = bottom (13 bits from 13) | right - 1
struct Footprint {
  uint32_t x, y;

  __device__ bool large() const { return x >> 31; }
  __device__ int left() const { return int(x & 0x1fff); }
  __device__ int top() const { return int(x >> 13 & 0x1fff); }
  __device__ int width() const { return int(x >> 26 & 31) + 1; }
  __device__ int small_count() const { return large() ? 0 : __popc(y); }
};

// In the record's units: -(a dx^2 + b dx dy + c dy^2) = l - log2(1/255), a little outside.
__device__ inline TileEllipse ellipse_of_record(const float4& xyab, float c, float l) {
  return tile_ellipse(xyab.x, xyab.y, -xyab.z, -0.5f * xyab.w, -c, l + (7e-4f - kFaintest));
}

// The footprint of a splat with this box, of which the ellipse is known.
__device__ inline Footprint footprint_of(const TileBox& box) {
  const int width = box.right - box.left, height = box.bottom - box.top;
  if (width <= 0 || height <= 0) return {0, 0};
  const uint32_t corner = uint32_t(box.top) << 13 | uint32_t(box.left);
  if (int64_t(width) * height > 32) return {1u << 31 | corner, uint32_t(box.bottom) << 13 | uint32_t(box.right - 1)};
  uint32_t bits = 0;
  for (int row = 0; row < height; ++row) {
    const TileRun run = tile_run(box, box.top + row, kFrameTile);
    if (run.first < run.end) bits |= (kAll >> (32 - (run.end - run.first))) << (row * width + run.first - box.left);
  }
  return bits != 0 ? Footprint{uint32_t(width - 1) << 26 | corner, bits} : Footprint{0, 0};
}

// visit(tile, j) for the tiles of a small footprint; j counts them.
template <class Visit>
__device__ inline void for_small_tiles(const Footprint& footprint, int tile_width, const Visit& visit) {
  const int width = footprint.width(), first = footprint.top() * tile_width + footprint.left();
  // i / width = i * inverse >> 10 for i below 32, whichever way the reciprocal is rounded.
  const int inverse = int(1024 * reciprocal(float(width))) + 1;
  int j = 0;
  for (uint32_t bits = footprint.large() ? 0 : footprint.y; bits != 0; bits &= bits - 1, ++j) {
    const int i = __ffs(int(bits)) - 1, row = i * inverse >> 10;
    visit(first + i + row * (tile_width - width), j);
  }
}

// By the whole warp: visit(tile, j) for the tiles of the large footprint of lane `owner`, whose record is `records[splat]`; the
// visits of a splat are spread over the lanes. Returns how many there are.
template <class Visit>
__device__ inline int for_large_tiles(const Footprint& mine, const Record<4>* records, int64_t splat, int owner, int tile_width,
                                      const Visit& visit) {
  const int lane = threadIdx.x & 31;
  const Footprint f = {__shfl_sync(kAll, mine.x, owner), __shfl_sync(kAll, mine.y, owner)};
  const Record<4>& r = records[__shfl_sync(kAll, splat, owner)];
  const TileBox box = {f.left(), f.top(), int(f.y & 0x1fff) + 1, int(f.y >> 13 & 0x3fff), ellipse_of_record(r.xyab, r.c, r.l)};
  int total = 0;
  for (int first_row = box.top; first_row < box.bottom; first_row += 32) {
    const TileRun run = first_row + lane < box.bottom ? tile_run(box, first_row + lane, kFrameTile) : TileRun{0, 0};
    const int length = max(run.end - run.first, 0);
    int through = length;  // of this row and those before
    for (int step = 1; step < 32; step *= 2) {
      const int before = __shfl_up_sync(kAll, through, step);
      if (lane >= step) through += before;
    }
    for (int row = 0; row < 32 && first_row + row < box.bottom; ++row) {
      const int first = __shfl_sync(kAll, run.first, row), count = __shfl_sync(kAll, length, row);
      const int start = total + __shfl_sync(kAll, through, row) - count, tile = (first_row + row) * tile_width + first;
      for (int column = lane; column < count; column += 32) visit(tile + column, start + column);
    }
    total += __shfl_sync(kAll, through, 31);
  }
  return total;
}

}  // namespace
