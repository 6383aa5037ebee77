// Where a coordinate in [-1, 1] falls on a grid whose first and last cells lie at the ends. Only kernel files include this.
#pragma once

#include "simd.h"

namespace GSPLAT_ISA::hexplane {

struct LinePosition {
  int64_t cell;    // the left one of two neighbours
  float fraction;  // of the way to the right one
  float slope;     // cells per unit of the coordinate, zero at the border and beyond
};

// NaN gives the first cell with a NaN fraction, so that it propagates into the result and nothing outside is read.
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
