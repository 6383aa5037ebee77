// The tiles of each row that an ellipse touches: the geometry of tiles_cpu.cpp, one splat per thread.
#pragma once

#include "tiles.h"

namespace gsplat::tiles {

// a dx^2 + 2 b dx dy + c dy^2 = k around (x, y), solved for dx: slope dy +- sqrt(offset - curve dy^2).
struct TileEllipse {
  float x, y, slope, offset, curve;
  float top;    // dy of the rightmost point; the leftmost is at -top
  bool proper;  // if false, the conic is not a proper ellipse in float32, and only the box is used
};

// The tiles that a splat may touch: columns [left, right), rows [top, bottom); empty if the splat is invisible.
struct TileBox {
  int left, top, right, bottom;
  TileEllipse ellipse;
};

__device__ inline TileEllipse tile_ellipse(float x, float y, float a, float b, float c, float k) {
  const float ac = a * c, inverse = 1.0f / a;
  const float det = fmaf(-5e-7f, ac, fmaf(-b, b, ac));  // the margin makes rounding errors of det only widen the ellipse
  const float top = -b * sqrtf(k / (c * det));
  const bool proper = a > 0 && c > 0 && det > 1e-6f * ac && fabsf(top) <= 1e30f;
  return {x, y, -b * inverse, k * inverse, det * inverse * inverse, top, proper};
}

// Return the tiles of the grid within (rx, ry) pixels of (x, y).
__device__ inline TileBox box_around(float x, float y, float rx, float ry, float size, int grid_width, int grid_height) {
  const float width = float(grid_width), height = float(grid_height);
  TileBox box = {};
  box.left = int(fminf(fmaxf((x - rx) / size, 0.0f), width));
  box.top = int(fminf(fmaxf((y - ry) / size, 0.0f), height));
  box.right = int(ceilf(fminf(fmaxf((x + rx) / size, 0.0f), width)));
  box.bottom = int(ceilf(fminf(fmaxf((y + ry) / size, 0.0f), height)));
  return box;
}

__device__ inline TileBox tile_box(const SplatBoxes& in, int64_t i) {
  const float x = in.means2d[2 * i], y = in.means2d[2 * i + 1];
  const float rx = float(in.radii[2 * i]), ry = float(in.radii[2 * i + 1]);
  const TileBox none = {};
  if (!(rx > 0 && ry > 0 && isfinite(x) && isfinite(y) && isfinite(in.depths[i]))) return none;
  if (in.image_ids != nullptr && (in.image_ids[i] < 0 || in.image_ids[i] >= in.images)) return none;
  TileBox box = box_around(x, y, rx, ry, float(in.tile_size), in.tile_width, in.tile_height);
  if (in.conics == nullptr) return box;
  const float a = in.conics[3 * i], b = in.conics[3 * i + 1], c = in.conics[3 * i + 2], opacity = in.opacities[i];
  if (!(opacity > 0 && opacity <= 3e38f && isfinite(a) && isfinite(b) && isfinite(c))) return none;
  const float k = fmaf(log2f(opacity * 255.0f), 1.3862944f, 1e-3f);  // 2 ln(255 o), slightly outside of alpha = 1/255
  if (!(k >= 0)) return none;
  box.ellipse = tile_ellipse(x, y, a, b, c, k);
  return box;
}

// The columns [first, end) of a row of tiles; empty if first >= end.
struct TileRun {
  int first, end;
};

// Return the run of tiles of `row` that the splat touches. Every sum of a product is one explicit fmaf, so that a splat
// has the same runs in every kernel.
__device__ inline TileRun tile_run(const TileBox& box, int row, float size) {
  constexpr float kSlack = 2e-3f;  // pixels, tolerance for rounding
  const TileEllipse& e = box.ellipse;
  if (!e.proper) return {box.left, box.right};
  const float inverse = 1.0f / size, box_first = float(box.left), box_end = float(box.right);
  const float low = fmaf(float(row), size, 0.5f - e.y), high = low + (size - 1);
  const float at_right = fminf(fmaxf(e.top, low), high), at_left = fminf(fmaxf(-e.top, low), high);
  const float right_square = fmaf(-e.curve * at_right, at_right, e.offset);
  const float left_square = fmaf(-e.curve * at_left, at_left, e.offset);
  if (!(fminf(right_square, left_square) >= 0)) return {0, 0};
  const float right = fmaf(e.slope, at_right, e.x) + sqrtf(right_square) + kSlack;
  const float left = fmaf(e.slope, at_left, e.x) - sqrtf(left_square) - kSlack;
  // Tile t contains the pixel centres t size + 0.5 ... t size + size - 0.5. The gap between the centres of two adjacent
  // tiles belongs to neither.
  int first = int(fminf(fmaxf((left + 0.5f) * inverse, box_first), box_end));
  if (left > fmaf(float(first + 1), size, -0.5f)) ++first;
  const int end = int(fminf(fmaxf(fmaf(right - 0.5f, inverse, 1.0f), box_first), box_end));
  return {first, end};
}

// Call visit(row, first, end) for every row of tiles that the splat touches, with its run of columns [first, end).
template <class Visit>
__device__ inline void for_tile_rows(const TileBox& box, float size, const Visit& visit) {
  if (box.right <= box.left) return;
  for (int row = box.top; row < box.bottom; ++row) {
    const TileRun run = tile_run(box, row, size);
    if (run.first < run.end) visit(row, run.first, run.end);
  }
}

}  // namespace gsplat::tiles
