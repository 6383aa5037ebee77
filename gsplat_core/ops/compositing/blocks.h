// Shared by the forward and the backward CPU kernels: the blocks of a window, the blocks that a splat touches, and its
// alpha in a block.
#pragma once

#include "compositing.h"
#include "constants.h"
#include "simd.h"

namespace GSPLAT_ISA::compositing {

using namespace gsplat::compositing;
using gsplat::kLog2AlphaCutoff;
using gsplat::kMinTransmittance;

void make_records(const Inputs& in, int64_t begin, int64_t end, SplatRecord* records);
int64_t scratch_floats(int channels);
void composite_tile(const Splats& in, int64_t tile, const Pixels& out, float* scratch);
void composite_tile_backward(const Splats& in, int64_t tile, const PictureGradient& from, const GradientRows& out,
                             float* scratch);
void gather(const Splats& in, const GradientRows& from, const int32_t* first, int64_t begin, int64_t end,
            const InputGradients& out);

namespace {

constexpr int kBlockWidth = 4;
constexpr int kBlockHeight = kLanes / kBlockWidth;
constexpr int kColumns = kWindow / kBlockWidth;
constexpr int kRows = kWindow / kBlockHeight;
constexpr int kBlocks = kColumns * kRows;
constexpr int kPixels = kWindow * kWindow;

// Return the index of pixel (x, y) of a window in arrays ordered block by block.
GSPLAT_INLINE int place(int x, int y) {
  return (y / kBlockHeight * kColumns + x / kBlockWidth) * kLanes + y % kBlockHeight * kBlockWidth + x % kBlockWidth;
}

// Four horizontally adjacent pixels; also contiguous in a block.
typedef float quad __attribute__((vector_size(16)));
GSPLAT_INLINE quad load_quad(const float* p) {
  quad v;
  __builtin_memcpy(&v, p, sizeof(v));
  return v;
}
GSPLAT_INLINE void store_quad(float* p, quad v) { __builtin_memcpy(p, &v, sizeof(v)); }

// Transpose 4x4 values between 4 channels of 4 pixels and 4 pixels of 4 channels.
GSPLAT_INLINE void transpose(quad& a, quad& b, quad& c, quad& d) {
  const quad ab_low = __builtin_shufflevector(a, b, 0, 4, 1, 5), ab_high = __builtin_shufflevector(a, b, 2, 6, 3, 7);
  const quad cd_low = __builtin_shufflevector(c, d, 0, 4, 1, 5), cd_high = __builtin_shufflevector(c, d, 2, 6, 3, 7);
  a = __builtin_shufflevector(ab_low, cd_low, 0, 1, 4, 5);
  b = __builtin_shufflevector(ab_low, cd_low, 2, 3, 6, 7);
  c = __builtin_shufflevector(ab_high, cd_high, 0, 1, 4, 5);
  d = __builtin_shufflevector(ab_high, cd_high, 2, 3, 6, 7);
}

// Offsets of a block's pixels from its first pixel.
GSPLAT_INLINE vfloat lane_x() {
  vfloat v;
  for (int i = 0; i < kLanes; ++i) v[i] = float(i % kBlockWidth);
  return v;
}
GSPLAT_INLINE vfloat lane_y() {
  vfloat v;
  for (int i = 0; i < kLanes; ++i) v[i] = float(i / kBlockWidth);
  return v;
}

// log2(alpha) of one splat at the pixels (x, y), before clamping and cut-off.
struct Falloff {
  vfloat dx, dy, power;
};
GSPLAT_INLINE Falloff falloff(const SplatRecord& record, vfloat x, vfloat y) {
  Falloff f;
  f.dx = x - record.x;
  f.dy = y - record.y;
  const vfloat across = fma(splat(record.b), f.dy, f.dx * record.a);
  const vfloat down = fma(f.dy * record.c, f.dy, splat(record.l));
  f.power = fma(across, f.dx, down);
  return f;
}

// Test kLanes splats, one per lane, against every block of the window whose first pixel centre is (x, y). Calls
// on_block(block, mask of the lanes whose ellipse may reach a pixel of the block).
//
// Within a strip of pixel rows an ellipse extends in x from the left to the right solution of a dx^2 + 2 b dx dy + c
// dy^2 = k at the dy of the strip nearest to the outermost point.
template <class OnBlock>
GSPLAT_INLINE void test_blocks(const SplatRecord* records, const int32_t* ids, int count, float x, float y,
                               const OnBlock& on_block) {
  alignas(64) float fields[6][kLanes];
  for (int i = 0; i < kLanes; ++i) {
    const SplatRecord& record = records[ids[i < count ? i : 0]];
    fields[0][i] = record.x;
    fields[1][i] = record.y;
    fields[2][i] = record.a;
    fields[3][i] = record.b;
    fields[4][i] = record.c;
    fields[5][i] = i < count ? record.l : -__builtin_inff();
  }
  const vfloat zero = {}, ux = load(fields[0]) - x, uy = load(fields[1]) - y;
  const vfloat a = -load(fields[2]), b = load(fields[3]) * -0.5f, c = -load(fields[4]);
  const vfloat k = load(fields[5]) + (2e-3f - kLog2AlphaCutoff);  // slightly larger than the contour, to allow for rounding
  const vfloat ac = a * c, det = fma(-b, b, ac) - ac * 5e-7f;
  const vmask reaches = at_least(k, zero);
  // Where the conic is not a proper ellipse in float32, test pixel by pixel.
  const vfloat proper_det = det - ac * 1e-6f;
  const vmask proper = above(a, zero) & above(c, zero) & above(proper_det, zero);
  const vfloat inverse = 1.0f / a;
  const vfloat slope = -b * inverse, offset = k * inverse, curve = det * inverse * inverse;
  const vfloat top = -b * sqrt(k / (c * det));
  const vmask everywhere = reaches & ~(proper & at_least(splat(1e30f), larger(top, -top)));
  for (int row = 0; row < kRows; ++row) {
    const vfloat low = float(row * kBlockHeight) - uy, high = low + float(kBlockHeight - 1);
    const vfloat at_right = smaller(larger(top, low), high), at_left = smaller(larger(-top, low), high);
    const vfloat right_square = fma(-curve * at_right, at_right, offset), left_square = fma(-curve * at_left, at_left, offset);
    const vmask inside = reaches & at_least(smaller(right_square, left_square), zero);
    const vfloat right = fma(slope, at_right, ux) + sqrt(larger(right_square, zero)) + 2e-3f;
    const vfloat left = fma(slope, at_left, ux) - sqrt(larger(left_square, zero)) - 2e-3f;
    for (int column = 0; column < kColumns; ++column) {
      const float first = float(column * kBlockWidth);
      const vmask hit = inside & at_least(right, splat(first)) & at_least(splat(first + float(kBlockWidth - 1)), left);
      on_block(row * kColumns + column, vmask(hit | everywhere));
    }
  }
}

// Prefetch scattered records while earlier ones are blended.
GSPLAT_INLINE void prefetch_records(const Splats& in, int64_t first, int count) {
  const int64_t end = first + count < in.instances ? first + count : in.instances;
  for (int64_t i = first < 0 ? 0 : first; i < end; ++i) __builtin_prefetch(in.records + in.flatten_ids[i]);
}

// A tile's image, range of instances and pixel bounds.
struct Tile {
  int64_t image, begin, end;  // range of instances
  int x, y, right, bottom;    // first pixel, and one past the last
  bool masked;
};
GSPLAT_INLINE Tile tile_of(const Splats& in, int64_t tile) {
  const int64_t tiles = int64_t(in.tile_width) * in.tile_height, image = tile / tiles, inside = tile % tiles;
  Tile t;
  t.image = image;
  t.begin = in.offsets[tile];
  t.end = tile + 1 < tiles * in.images ? in.offsets[tile + 1] : in.instances;
  t.x = int(inside % in.tile_width) * in.tile_size;
  t.y = int(inside / in.tile_width) * in.tile_size;
  t.right = t.x + in.tile_size < in.width ? t.x + in.tile_size : in.width;
  t.bottom = t.y + in.tile_size < in.height ? t.y + in.tile_size : in.height;
  t.masked = in.masks != nullptr && !in.masks[tile];
  return t;
}

}  // namespace

}  // namespace GSPLAT_ISA::compositing
