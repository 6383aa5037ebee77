// Weight, depth and bins of one splat in one pixel, and their gradients.
#pragma once

#include "range_histogram.h"

namespace gsplat::range_histogram {

using ray_blending::kLeastDenominator;
using ray_blending::kLx;
using ray_blending::kLy;
using ray_blending::kMxx;
using ray_blending::kMxy;
using ray_blending::kMyy;
using ray_blending::kNx;
using ray_blending::kNy;
using ray_blending::kReach;
using ray_blending::kVariance;
using ray_blending::kZ;

// Integral of the normal distribution up to x, and its density (Abramowitz and Stegun 7.1.26, absolute error below 1e-7).
struct Normal {
  float cdf, density;
};
GSPLAT_HOST_DEVICE Normal normal_at(float x) {
  const float size = x < 0 ? -x : x, bell = __builtin_expf(-0.5f * x * x);
  const float t = 1.0f / (1.0f + 0.23164190f * size);
  const float tail =
      0.5f * bell * t * (0.254829592f + t * (-0.284496736f + t * (1.421413741f + t * (-1.453152027f + t * 1.061405429f))));
  return {x < 0 ? tail : 1.0f - tail, 0.39894228f * bell};
}

// A splat at a pixel. `alpha` is 0 where it is skipped.
struct Hit {
  float dx, dy, falloff, alpha;  // offset of the pixel from the mean; exp(-sigma)
  bool limited;                  // alpha is at its maximum
};
GSPLAT_HOST_DEVICE Hit hit_of(const Inputs& in, int64_t id, float x, float y) {
  const compositing::Inputs& splats = in.splats.splats;
  Hit hit = {x - splats.means2d[2 * id], y - splats.means2d[2 * id + 1], 0, 0, false};
  const float *const conic = splats.conics + 3 * id, *const ray = in.splats.rays + kRayNumbers * id;
  const float opacity = splats.opacities[id];
  const float sigma = 0.5f * (conic[0] * hit.dx * hit.dx + conic[2] * hit.dy * hit.dy) + conic[1] * hit.dx * hit.dy;
  if (!(sigma >= 0)) return hit;
  hit.falloff = __builtin_expf(-sigma);
  const float alpha = opacity * hit.falloff;
  if (!(alpha >= kAlphaCutoff && alpha < 1e30f)) return hit;
  float finite = 0;  // NaN if a coefficient is not finite
  for (int k = 0; k < kRayNumbers; ++k) finite += 0 * ray[k];
  if (!(finite == 0)) return hit;
  hit.limited = alpha > splats.alpha.most;
  hit.alpha = hit.limited ? splats.alpha.most : alpha;
  return hit;
}

// Depth along the ray in bins from the first edge, its standard deviation in bins, and the bins within reach.
struct Depth {
  float denominator, free, depth, variance, factor;  // before scaling; `depth` is `free` within the limits
  float at, spread;
  int first, end;
};
GSPLAT_HOST_DEVICE Depth depth_of(const Inputs& in, int64_t id, const Hit& hit, float factor) {
  const float* const ray = in.splats.rays + kRayNumbers * id;
  Depth d;
  const float denominator =
      (ray[kMxx] * hit.dx + ray[kMxy] * hit.dy + ray[kLx]) * hit.dx + (ray[kMyy] * hit.dy + ray[kLy]) * hit.dy + 1.0f;
  d.denominator = denominator > kLeastDenominator ? denominator : kLeastDenominator;
  d.free = (ray[kZ] + ray[kNx] * hit.dx + ray[kNy] * hit.dy) / d.denominator;
  const float low = ray[kZ] - ray[kReach], high = ray[kZ] + ray[kReach];
  d.depth = d.free > low ? d.free : low;
  d.depth = d.depth < high ? d.depth : high;
  d.variance = ray[kVariance] / d.denominator;
  d.factor = factor;
  d.at = (d.depth * factor - in.nearest) / in.bin;
  const float spread = __builtin_sqrtf(d.variance > 0 ? d.variance : 0) * factor / in.bin;
  d.spread = spread > 1e-6f ? spread : 1e-6f;
  const float first = __builtin_floorf(d.at - kReachSigmas * d.spread), end = __builtin_ceilf(d.at + kReachSigmas * d.spread);
  // A NaN compares false and reaches no bin.
  d.first = first > 0 ? (first < float(in.bins) ? int(first) : in.bins) : 0;
  d.end = end > 0 ? (end < float(in.bins) ? int(end) : in.bins) : 0;
  return d;
}

// <v, mass in the bins> of a splat for v [bins], and its gradients by the depth and its spread, in bins.
struct BinGradients {
  float value;  // <v, mass>
  float v_at, v_spread;
};
GSPLAT_HOST_DEVICE BinGradients bin_gradients(const Depth& d, const float* v) {
  BinGradients g = {0, 0, 0};
  if (d.first >= d.end) return g;
  const float inverse = 1 / d.spread;
  float u = (float(d.first) - d.at) * inverse;
  Normal below = normal_at(u);
  for (int b = d.first; b < d.end; ++b) {
    const float next_u = (float(b + 1) - d.at) * inverse;
    const Normal next = normal_at(next_u);
    g.value += v[b] * (next.cdf - below.cdf);
    g.v_at += v[b] * (below.density - next.density);
    g.v_spread += v[b] * (below.density * u - next.density * next_u);
    u = next_u, below = next;
  }
  g.v_at *= inverse;
  g.v_spread *= inverse;
  return g;
}

// Gradients of a splat at one pixel, given dL/dalpha, its weight, and those of its bins: kGradients values.
GSPLAT_HOST_DEVICE void splat_gradients(const Inputs& in, int64_t id, const Hit& hit, const Depth& d, float weight,
                                        const BinGradients& bins, float v_alpha, float* out) {
  const compositing::Inputs& splats = in.splats.splats;
  const float *const conic = splats.conics + 3 * id, *const ray = in.splats.rays + kRayNumbers * id;
  const float scale = weight * d.factor / in.bin;
  const float v_depth = scale * bins.v_at;
  const bool within = d.free == d.depth;
  const float v_numerator = within ? v_depth / d.denominator : 0;
  float v_denominator = -v_numerator * d.depth, v_variance = 0;
  if (d.variance > 0 && d.spread > 1e-6f) {
    const float v_square = scale * bins.v_spread * 0.5f / __builtin_sqrtf(d.variance);  // of the variance at this pixel
    v_variance = v_square / d.denominator;
    v_denominator -= v_square * d.variance / d.denominator;
  }
  const float outside = within ? 0 : v_depth;
  float* const v_ray = out + 6;
  v_ray[kZ] = v_numerator + outside;
  v_ray[kNx] = v_numerator * hit.dx;
  v_ray[kNy] = v_numerator * hit.dy;
  v_ray[kLx] = v_denominator * hit.dx;
  v_ray[kLy] = v_denominator * hit.dy;
  v_ray[kMxx] = v_denominator * hit.dx * hit.dx;
  v_ray[kMxy] = v_denominator * hit.dx * hit.dy;
  v_ray[kMyy] = v_denominator * hit.dy * hit.dy;
  v_ray[kReach] = d.free > d.depth ? outside : -outside;
  v_ray[kVariance] = v_variance;
  float v_dx = v_numerator * ray[kNx] + v_denominator * (ray[kLx] + 2 * ray[kMxx] * hit.dx + ray[kMxy] * hit.dy);
  float v_dy = v_numerator * ray[kNy] + v_denominator * (ray[kLy] + 2 * ray[kMyy] * hit.dy + ray[kMxy] * hit.dx);
  // Where alpha is at its maximum, opacity and shape have no gradient.
  const float free_alpha = hit.limited ? 0 : v_alpha, v_sigma = -free_alpha * hit.alpha;
  v_dx += v_sigma * (conic[0] * hit.dx + conic[1] * hit.dy);
  v_dy += v_sigma * (conic[2] * hit.dy + conic[1] * hit.dx);
  out[0] = -v_dx;
  out[1] = -v_dy;
  out[2] = 0.5f * v_sigma * hit.dx * hit.dx;
  out[3] = v_sigma * hit.dx * hit.dy;
  out[4] = 0.5f * v_sigma * hit.dy * hit.dy;
  out[5] = free_alpha * hit.falloff;
}

// Range of list entries and of pixels of a tile.
struct Tile {
  int64_t begin, end;
  int x, y, right, bottom;
};
GSPLAT_HOST_DEVICE Tile tile_of(const Inputs& in, int64_t tile) {
  const compositing::Inputs& s = in.splats.splats;
  Tile t;
  t.begin = s.offsets[tile];
  t.end = tile + 1 < int64_t(s.tile_width) * s.tile_height ? s.offsets[tile + 1] : s.instances;
  t.x = int(tile % s.tile_width) * s.tile_size;
  t.y = int(tile / s.tile_width) * s.tile_size;
  t.right = t.x + s.tile_size < s.width ? t.x + s.tile_size : s.width;
  t.bottom = t.y + s.tile_size < s.height ? t.y + s.tile_size : s.height;
  return t;
}
GSPLAT_HOST_DEVICE float factor_at(const Inputs& in, int x, int y) {
  return in.factors == nullptr ? 1.0f : in.factors[int64_t(y) * in.splats.splats.width + x];
}

}  // namespace gsplat::range_histogram
