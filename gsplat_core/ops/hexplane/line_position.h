// Position of a coordinate in [-1, 1] on a grid whose first and last cells are at the ends of the interval. Only kernel
// files include this.
#pragma once

#include "simd.h"

namespace GSPLAT_ISA::hexplane {

struct LinePosition {
  int64_t cell;    // left one of two neighbours
  float fraction;  // fractional position between the left and the right cell
  float slope;     // cells per unit of the coordinate, zero at the border and beyond
};

// NaN maps to the first cell with a NaN fraction. It propagates into the result without reading out of bounds.
GSPLAT_INLINE LinePosition position_on(float coordinate, int32_t size) {
  const float scale = 0.5f * float(size - 1);
  const float unclamped = (coordinate + 1.0f) * scale;
  float at = unclamped;
  if (at < 0.0f) at = 0.0f;
  if (at > float(size - 1)) at = float(size - 1);
  int64_t cell = at >= 0.0f ? int64_t(at) : 0;
  if (cell > size - 2) cell = size > 1 ? size - 2 : 0;
  return {cell, at - float(cell), unclamped > 0.0f && unclamped < float(size - 1) ? scale : 0.0f};
}

}  // namespace GSPLAT_ISA::hexplane
