// What blending forward and backward share: the window of a block, a splat's falloff, and which splats reach a warp. It does not
// matter here where the splats come from.
#pragma once

#include "splat_records.cuh"

namespace {

constexpr int kBlockThreads = 128;
constexpr int kWarps = kBlockThreads / 32;
constexpr int kQuadrant = 8;  // pixels on a side
constexpr int kPixelsEach = 2;
constexpr unsigned kAll = 0xffffffffu;

// Lane i has column i % 8 of its warp's quadrant, and two rows: the lower 16 lanes have the upper half of the quadrant.
__device__ constexpr int row_of_lane(int lane, int p) { return lane / 16 * 4 + lane / 8 % 2 + 2 * p; }

// A block's window of 16x16 pixels: the positions of its splats in the caller's lists, and where its warps and threads are.
struct Window {
  int begin, end;
  int left, top;               // first pixel of the window
  int right, bottom;           // behind its last pixel in the picture
  int quadrant_x, quadrant_y;  // first pixel of the warp's quadrant
  int x, y[kPixelsEach];       // this thread's pixels
  bool inside[kPixelsEach];

  // The window starts at pixel (left, top); pixels at or beyond (right, bottom) are outside.
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
  float dx, dy, power;  // log2(alpha) before the cut-offs
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

// Whether the contour alpha = 1/255 may reach a pixel centre of the quadrant whose first centre is (x, y). Its part in the
// quadrant's rows reaches in x from the left to the right solution of a dx^2 + 2 b dx dy + c dy^2 = k at the dy of those rows
// that is nearest to the outermost point; never less than that, for a splat left out would be missing in the image.
template <int D>
__device__ inline bool reaches(const Record<D>& r, float x, float y) {
  const float k = r.l + (2e-3f - kFaintest);  // a little outside of the contour, against rounding
  if (!(k >= 0)) return false;
  const float a = -r.xyab.z, b = -0.5f * r.xyab.w, c = -r.c, ux = r.xyab.x - x, uy = r.xyab.y - y;
  const float ac = a * c, det = fmaf(-b, b, ac) - ac * 5e-7f;
  const float top = -b * sqrtf(k / (c * det));
  if (!(a > 0 && c > 0 && det > ac * 1e-6f && fabsf(top) <= 1e30f)) return true;  // no proper ellipse: pixel by pixel
  const float inverse = 1.0f / a, slope = -b * inverse, offset = k * inverse, curve = det * inverse * inverse;
  const float low = -uy, high = low + float(kQuadrant - 1);
  const float at_right = fminf(fmaxf(top, low), high), at_left = fminf(fmaxf(-top, low), high);
  const float right_square = fmaf(-curve * at_right, at_right, offset), left_square = fmaf(-curve * at_left, at_left, offset);
  if (!(fminf(right_square, left_square) >= 0)) return false;
  const float right = fmaf(slope, at_right, ux) + sqrtf(right_square) + 2e-3f;
  const float left = fmaf(slope, at_left, ux) - sqrtf(left_square) - 2e-3f;
  return right >= 0 && left <= float(kQuadrant - 1);
}

}  // namespace
