// A splat's contour and the pixels that it reaches, shared by the CPU's vectors and CUDA's threads.
#pragma once

#include "simd.h"
#include "weighted_sum.h"

namespace GSPLAT_ISA::weighted_sum {

constexpr float kLog2E = 1.44269504f;

struct Contour {
  vfloat a, b, c, l, threshold, half_width, half_height, sign;
};

// Return the coefficients of log2(|o| G), and half of the box that contains the pixels with G and |o| G of at least
// 1/255. The box is negative where a value is not finite, the conic is not positive definite, or no pixel is reached.
GSPLAT_INLINE Contour contour_of(const vfloat mean[2], const vfloat conic[3], vfloat opacity, vfloat weight) {
  Contour r;
  const vfloat zero = splat(0.0f), most = splat(3e38f);
  const vfloat size = max(opacity, -opacity);
  const vint positive = size > 1e-30f;
  r.l = log2(select(positive, min(size, most), splat(1.0f)));
  r.sign = select(opacity < zero, splat(-1.0f), splat(1.0f));
  r.threshold = gsplat::kLog2AlphaCutoff + max(r.l, zero);
  r.a = conic[0] * (-0.5f * kLog2E);
  r.b = conic[1] * -kLog2E;
  r.c = conic[2] * (-0.5f * kLog2E);
  const vfloat det = conic[0] * conic[2] - conic[1] * conic[1];
  const vfloat reach = min(r.l, zero) - gsplat::kLog2AlphaCutoff;  // in powers of 2
  vint valid = positive & (size <= most) & (reach >= zero) & (conic[0] > zero) & (conic[2] > zero) & (det > zero);
  valid &= (conic[0] <= most) & (conic[2] <= most) & (det <= most) & (max(weight, -weight) <= most);
  valid &= (max(mean[0], -mean[0]) <= 1e9f) & (max(mean[1], -mean[1]) <= 1e9f);
  const vfloat square = select(valid, 2.0f * 0.693147181f * reach / select(valid, det, splat(1.0f)), zero);
  // Slightly larger than the contour, to allow for rounding; the comparison with the threshold decides.
  r.half_width = select(valid, sqrt(square * conic[2]) * 1.001f + 0.01f, splat(-1.0f));
  r.half_height = select(valid, sqrt(square * conic[0]) * 1.001f + 0.01f, splat(-1.0f));
  return r;
}

// First and last pixel whose centre is within `half` of `centre`, limited to `from` and `to` - 1; empty if last < first.
struct Range {
  int first, last;
};
GSPLAT_INLINE Range range_of(float centre, float half, int from, int to) {
  const float low = centre - half - 0.5f, high = centre + half - 0.5f;
  Range r;
  r.first = low <= float(from) ? from : low >= float(to) ? to : int(low);
  r.last = high < float(from) ? from - 1 : high >= float(to - 1) ? to - 1 : int(high);
  return r;
}

}  // namespace GSPLAT_ISA::weighted_sum
