// Splats and windows of CUDA blending, forward and backward: a splat's record and its falloff, the window of a thread
// block, and splats staged in shared memory.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>

#include "constants.h"

namespace gsplat::blending {
namespace {

constexpr float kLn2 = 0.69314718f, kLog2E = 1.44269504f;

// log2(alpha) = a dx^2 + b dx dy + c dy^2 + l with (dx, dy) from the mean to the pixel. A splat with a non-finite value
// has l = -infinity, so that it reaches no pixel. Pixels where log2(alpha) exceeds `cap` are skipped: `cap` is l for an
// indefinite conic (sigma would be negative), else infinity. With D > 0 the colours follow, from the end of the last 16
// bytes on.
template <int D>
struct alignas(16) Record {
  float4 xyab;
  float c, l, cap;
  float colors[D <= 1 ? 1 : (D + 6) / 4 * 4 - 3];
};
static_assert(sizeof(Record<0>) == 32 && sizeof(Record<1>) == 32 && sizeof(Record<3>) == 48 && sizeof(Record<5>) == 48);

template <int D>
__device__ inline Record<D> faint_record() {
  Record<D> r = {};
  r.l = -INFINITY;
  return r;
}

// Set all fields except the colours from the mean (x, y), the conic (a, b, c) and log2 of the opacity. Pixels with log2
// alpha above `cap` are skipped. The default `cap` requires a positive definite conic.
template <int D>
__device__ inline void set_shape(Record<D>& r, float x, float y, const float* conic, float log2_opacity, float cap = INFINITY) {
  r.xyab = make_float4(x, y, -0.5f * kLog2E * conic[0], -kLog2E * conic[1]);
  r.c = -0.5f * kLog2E * conic[2];
  r.l = log2_opacity;
  r.cap = cap;
}

constexpr int kBlockThreads = 128;
constexpr int kWarps = kBlockThreads / 32;
constexpr int kQuadrant = 8;  // pixels per side
constexpr int kPixelsEach = 2;
constexpr unsigned kAll = 0xffffffffu;

// Lane i has column i % 8 of its warp's quadrant and two rows. The lower 16 lanes have the upper half of the quadrant.
__device__ constexpr int row_of_lane(int lane, int p) { return lane / 16 * 4 + lane / 8 % 2 + 2 * p; }

// A block's window of 16x16 pixels: the range of its splats in the caller's lists, and the pixels of its warps and
// threads.
struct Window {
  int begin, end;
  int left, top;               // first pixel of the window
  int right, bottom;           // one past the last pixel inside the image
  int quadrant_x, quadrant_y;  // first pixel of the warp's quadrant
  int x, y[kPixelsEach];       // this thread's pixels
  bool inside[kPixelsEach];

  // The window starts at pixel (left, top). Pixels at or beyond (right, bottom) are outside of the image.
  __device__ Window(int begin_, int end_, int left_, int top_, int right_, int bottom_)
      : begin(begin_), end(end_), left(left_), top(top_), right(right_), bottom(bottom_) {
    const int lane = threadIdx.x & 31, warp = threadIdx.x / 32;
    quadrant_x = left + warp % 2 * kQuadrant;
    quadrant_y = top + warp / 2 * kQuadrant;
    x = quadrant_x + lane % kQuadrant;
    for (int p = 0; p < kPixelsEach; ++p) {
      y[p] = quadrant_y + row_of_lane(lane, p);
      inside[p] = x < right && y[p] < bottom;
    }
  }
};

struct Falloff {
  float dx, dy, power;  // log2(alpha) before clamping and cut-off
};
template <int D>
__device__ inline Falloff falloff(const Record<D>& r, float x, float y) {
  const float dx = x - r.xyab.x, dy = y - r.xyab.y;
  return {dx, dy, fmaf(fmaf(r.xyab.w, dy, dx * r.xyab.z), dx, fmaf(dy * r.c, dy, r.l))};
}

__device__ inline float exp2_fast(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ inline float reciprocal(float x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

// Return false only if the contour alpha = 1/255 reaches no pixel centre of the quadrant whose first centre is (x, y).
// Within the quadrant's rows the ellipse extends in x from the left to the right solution of a dx^2 + 2 b dx dy + c
// dy^2 = k at the dy of those rows nearest to the outermost point. The extent must not be underestimated: an omitted
// splat would be missing in the image.
template <int D>
__device__ inline bool reaches(const Record<D>& r, float x, float y) {
  const float k = r.l + (2e-3f - kLog2AlphaCutoff);  // slightly larger than the contour, to allow for rounding
  if (!(k >= 0)) return false;
  const float a = -r.xyab.z, b = -0.5f * r.xyab.w, c = -r.c, ux = r.xyab.x - x, uy = r.xyab.y - y;
  const float ac = a * c, det = fmaf(-b, b, ac) - ac * 5e-7f;
  const float top = -b * sqrtf(k / (c * det));
  if (!(a > 0 && c > 0 && det > ac * 1e-6f && fabsf(top) <= 1e30f))
    return true;  // not a proper ellipse in float32: test pixel by pixel
  const float inverse = 1.0f / a, slope = -b * inverse, offset = k * inverse, curve = det * inverse * inverse;
  const float low = -uy, high = low + float(kQuadrant - 1);
  const float at_right = fminf(fmaxf(top, low), high), at_left = fminf(fmaxf(-top, low), high);
  const float right_square = fmaf(-curve * at_right, at_right, offset), left_square = fmaf(-curve * at_left, at_left, offset);
  if (!(fminf(right_square, left_square) >= 0)) return false;
  const float right = fmaf(slope, at_right, ux) + sqrtf(right_square) + 2e-3f;
  const float left = fmaf(slope, at_left, ux) - sqrtf(left_square) - 2e-3f;
  return right >= 0 && left <= float(kQuadrant - 1);
}

// log2(alpha / maximum) before the cut-offs, as a polynomial in the offset (x, y) from the window's centre to the
// pixel: one + y (by_y + y by_yy). one = k + x (by_x + x by_xx) and by_y = ky + x by_xy are constant in a pixel column.
// Values above `cap` are skipped.
template <int D>
struct alignas(16) StagedSplat {
  float k, by_x, by_xx, by_y, by_xy, by_yy;
  float colors[D];
  float cap;
};
static_assert(sizeof(StagedSplat<1>) == 32 && sizeof(StagedSplat<4>) == 48 && sizeof(StagedSplat<5>) == 48);

// Read a staged splat from a shared-memory address; `cap` only if kCapped. Inline assembly, because the compiler would
// otherwise reload the colours for every pixel.
template <int D, bool kCapped>
__device__ inline StagedSplat<D> staged_at(uint32_t address) {
  constexpr int kFloats = 6 + D + (kCapped ? 1 : 0);
  union {
    float floats[12];
    StagedSplat<D> splat;
  } read;
  const auto quad = [&](int at) {
    asm volatile("ld.shared.v4.f32 {%0, %1, %2, %3}, [%4];"
                 : "=f"(read.floats[at]), "=f"(read.floats[at + 1]), "=f"(read.floats[at + 2]), "=f"(read.floats[at + 3])
                 : "r"(address + 4 * at)
                 : "memory");
  };
  quad(0);
  quad(4);
  if constexpr (kFloats > 10) {
    quad(8);
  } else if constexpr (kFloats > 8) {
    asm volatile("ld.shared.v2.f32 {%0, %1}, [%2];" : "=f"(read.floats[8]), "=f"(read.floats[9]) : "r"(address + 32) : "memory");
  }
  return read.splat;
}
__device__ inline uint32_t shared_address(const void* at) { return uint32_t(__cvta_generic_to_shared(at)); }

// The cut-off of alpha = 1/255 in the polynomial's units.
__device__ inline float staged_cutoff(const AlphaLimit& limit) { return kLog2AlphaCutoff - limit.log2_most; }

// Stage a record; (x, y) is the window's centre. The order of operations is explicit, so that the forward and backward
// pass compute identical bits.
template <int D>
__device__ inline StagedSplat<D> staged(const Record<D>& r, float x, float y, const AlphaLimit& limit = {}) {
  const float a = r.xyab.z, b = r.xyab.w, c = r.c, dx = x - r.xyab.x, dy = y - r.xyab.y;
  StagedSplat<D> s;
  s.by_x = fmaf(2 * a, dx, __fmul_rn(b, dy));
  s.by_y = fmaf(2 * c, dy, __fmul_rn(b, dx));
  s.k = fmaf(fmaf(b, dy, __fmul_rn(a, dx)), dx, fmaf(__fmul_rn(c, dy), dy, r.l - limit.log2_most));
  s.by_xx = a;
  s.by_xy = b;
  s.by_yy = c;
  s.cap = r.cap - limit.log2_most;
  for (int d = 0; d < D; ++d) s.colors[d] = r.colors[d];
  return s;
}

__device__ inline float sqrt_fast(float x) {
  float y;
  asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

// Return the parts of the window in which the contour alpha = 1/255 may reach a pixel centre. Parts are 8 pixels wide
// and `kRows` high, numbered left to right, then downwards. (x, y) is the first pixel centre of the window. Within a
// part's rows the ellipse extends in x from the left to the right solution of a dx^2 + 2 b dx dy + c dy^2 = k at the dy
// of those rows nearest to the outermost point. The extent must not be underestimated: an omitted splat would be
// missing in the image. Where the ellipse does not reach the rows, the solutions are NaN and compare as false.
//
// Each thread of the warp has a splat if `shown`. Lane i returns the mask of the splats that reach part i.
template <int kRows, int D>
__device__ inline unsigned reaching_parts(bool shown, const Record<D>& r, float x, float y) {
  constexpr float kBeside = 2e-3f;                   // pixels, tolerance for rounding
  const float k = r.l + (2e-3f - kLog2AlphaCutoff);  // slightly larger than the contour, to allow for rounding
  const float a = -r.xyab.z, b = -0.5f * r.xyab.w, c = -r.c, ux = r.xyab.x - x, uy = r.xyab.y - y;
  const float ac = a * c, det = fmaf(-b, b, ac) - ac * 5e-7f;
  const float top = -b * sqrt_fast(k * reciprocal(c * det));
  const float inverse = reciprocal(a), slope = -b * inverse, offset = k * inverse, curve = det * inverse * inverse;
  const bool proper = a > 0 && c > 0 && det > ac * 1e-6f && fabsf(top) <= 1e30f;
  const int lane = threadIdx.x & 31;
  shown = shown && k >= 0;
  unsigned mine = 0;
#pragma unroll
  for (int band = 0; band < 2 * kQuadrant / kRows; ++band) {
    const float low = float(band * kRows) - uy, high = low + float(kRows - 1);
    const float at_right = fminf(fmaxf(top, low), high), at_left = fminf(fmaxf(-top, low), high);
    const float right = fmaf(slope, at_right, ux + kBeside) + sqrt_fast(fmaf(-curve * at_right, at_right, offset));
    const float left = fmaf(slope, at_left, ux - kBeside) - sqrt_fast(fmaf(-curve * at_left, at_left, offset));
#pragma unroll
    for (int column = 0; column < 2; ++column) {
      const float first = float(column * kQuadrant), last = float(column * kQuadrant + kQuadrant - 1);
      const unsigned reaching = __ballot_sync(kAll, shown && right >= first && left <= last);
      if (lane == 2 * band + column) mine = reaching;
    }
  }
  return mine | __ballot_sync(kAll, shown && !proper);
}

// Stage splat i of a batch, where i % 32 is the thread's lane, and store for each part of the window the mask of the
// splats that reach it. `any`: at least one thread of the warp has a splat.
template <int kRows, int D>
__device__ inline void stage_splat(int i, bool any, const Record<D>& r, const Window& w, StagedSplat<D>* splats,
                                   uint4* reached_by_part, const AlphaLimit& limit = {}) {
  const int lane = threadIdx.x & 31;
  unsigned reaching = 0;
  if (any) {
    splats[i] = staged(r, float(w.left + kQuadrant), float(w.top + kQuadrant), limit);
    reaching = reaching_parts<kRows>(true, r, float(w.left) + 0.5f, float(w.top) + 0.5f);
  }
  if (lane < 4 * kQuadrant / kRows) reinterpret_cast<unsigned*>(&reached_by_part[lane])[i / 32] = reaching;
}

}  // namespace

}  // namespace gsplat::blending
