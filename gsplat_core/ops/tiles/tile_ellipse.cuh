// Which tiles of a row an ellipse touches: the geometry of tiles_cpu.cpp, one splat per thread.
#pragma once

#include "tiles_cuda.h"

// a dx^2 + 2 b dx dy + c dy^2 = k around (x, y), solved for dx: slope dy +- sqrt(offset - curve dy^2).
struct TileEllipse {
  float x, y, slope, offset, curve;
  float top;    // dy of the rightmost point; the leftmost is at -top
  bool proper;  // elsewhere the conic is no proper ellipse in float32, and the box alone decides
};

// The tiles that a splat may touch: columns [left, right), rows [top, bottom); none where it is invisible.
struct TileBox {
  int left, top, right, bottom;
  TileEllipse ellipse;
};

__device__ inline TileEllipse tile_ellipse(float x, float y, float a, float b, float c, float k) {
  const float ac = a * c, det = fmaf(-b, b, ac) - 5e-7f * ac, inverse = 1.0f / a;  // rounding of det only widens the ellipse
  const float top = -b * sqrtf(k / (c * det));
  const bool proper = a > 0 && c > 0 && det > 1e-6f * ac && fabsf(top) <= 1e30f;
  return {x, y, -b * inverse, k * inverse, det * inverse * inverse, top, proper};
}

__device__ inline TileBox tile_box(const DeviceBoxes& in, int64_t i) {
  const float x = in.means2d[2 * i], y = in.means2d[2 * i + 1];
  const float rx = float(in.radii[2 * i]), ry = float(in.radii[2 * i + 1]);
  const TileBox none = {};
  if (!(rx > 0 && ry > 0 && isfinite(x) && isfinite(y) && isfinite(in.depths[i]))) return none;
  if (in.image_ids != nullptr && (in.image_ids[i] < 0 || in.image_ids[i] >= in.images)) return none;
  const float size = float(in.tile_size), width = float(in.tile_width), height = float(in.tile_height);
  TileBox box;
  box.left = int(fminf(fmaxf((x - rx) / size, 0.0f), width));
  box.top = int(fminf(fmaxf((y - ry) / size, 0.0f), height));
  box.right = int(ceilf(fminf(fmaxf((x + rx) / size, 0.0f), width)));
  box.bottom = int(ceilf(fminf(fmaxf((y + ry) / size, 0.0f), height)));
  box.ellipse = {};
  if (in.conics == nullptr) return box;
  const float a = in.conics[3 * i], b = in.conics[3 * i + 1], c = in.conics[3 * i + 2], opacity = in.opacities[i];
  if (!(opacity > 0 && opacity <= 3e38f && isfinite(a) && isfinite(b) && isfinite(c))) return none;
  const float k = fmaf(log2f(opacity * 255.0f), 1.3862944f, 1e-3f);  // 2 ln(255 o), a little outside of alpha = 1/255
  if (!(k >= 0)) return none;
  box.ellipse = tile_ellipse(x, y, a, b, c, k);
  return box;
}

// visit(row, first, end) for every row of tiles that the splat touches, with its run of columns [first, end).
template <class Visit>
__device__ inline void for_tile_rows(const DeviceBoxes& in, const TileBox& box, const Visit& visit) {
  constexpr float kSlack = 2e-3f;  // pixels, against rounding
  const TileEllipse& e = box.ellipse;
  const float size = float(in.tile_size), inverse = 1.0f / size;
  const float box_first = float(box.left), box_end = float(box.right);
  if (box.right <= box.left) return;
  for (int row = box.top; row < box.bottom; ++row) {
    if (!e.proper) {
      visit(row, box.left, box.right);
      continue;
    }
    const float low = fmaf(float(row), size, 0.5f - e.y), high = low + (size - 1);
    const float at_right = fminf(fmaxf(e.top, low), high), at_left = fminf(fmaxf(-e.top, low), high);
    const float right_square = fmaf(-e.curve * at_right, at_right, e.offset);
    const float left_square = fmaf(-e.curve * at_left, at_left, e.offset);
    if (!(fminf(right_square, left_square) >= 0)) continue;
    const float right = fmaf(e.slope, at_right, e.x) + sqrtf(right_square) + kSlack;
    const float left = fmaf(e.slope, at_left, e.x) - sqrtf(left_square) - kSlack;
    // Tile t holds the pixel centres t size + 0.5 ... t size + size - 0.5; a gap between two tiles' centres is in neither.
    int first = int(fminf(fmaxf((left + 0.5f) * inverse, box_first), box_end));
    if (left > fmaf(float(first + 1), size, -0.5f)) ++first;
    const int end = int(fminf(fmaxf((right - 0.5f) * inverse + 1.0f, box_first), box_end));
    if (first < end) visit(row, first, end);
  }
}
