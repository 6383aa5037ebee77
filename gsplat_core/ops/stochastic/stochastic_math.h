// Projection, random draws and points of stochastic rendering, shared by the CPU and CUDA kernels.
#pragma once

#include "../projection/projection_math.h"
#include "constants.h"
#include "inverse_dilogarithm.h"
#include "philox.h"
#include "quantised.h"
#include "simd.h"
#include "stochastic.h"

namespace GSPLAT_ISA::stochastic {

using namespace gsplat::stochastic;
using namespace projection;

constexpr float kBlurPx2 = 0.3f;
constexpr float kNearPlane = 0.01f, kFarPlane = 1e10f;
constexpr float kBoxMarginPx = 0.01f;  // more than the rounding of a box, whose fragments are tested one by one
constexpr float kLog2e = 1.44269504f;
constexpr float kCutoffDilogarithm = 0.0039254184f;  // Li2(kAlphaCutoff)
constexpr double kInversionLimit = 30;               // rates from which PTRS draws
constexpr float kPointsPerFragment = 1;              // splats with more points than that are drawn fragment by fragment
constexpr float kMostPoints = 1e9f;

// Kinds of random numbers, in the upper bits of a counter's last word.
enum Stream : uint32_t { kAlphaStream = 0, kCountStream = 1u << 28, kPointStream = 2u << 28, kFragmentStream = 3u << 28 };

// Scalar functions under the names that CPU kernels use for vectors.
#if defined(__CUDACC__)
#define GSPLAT_MATH(name) ::name
#else
#define GSPLAT_MATH(name) __builtin_##name
#endif

GSPLAT_INLINE uint32_t bits_of(float x) {
  uint32_t word;
  __builtin_memcpy(&word, &x, sizeof(word));
  return word;
}

GSPLAT_INLINE uint64_t word_of(float z, uint32_t row) { return uint64_t(bits_of(z)) << 32 | row; }

// ---- Dilogarithm Li2, which gives the mean number of points of a splat ----

// Return the dilogarithm Li2(x) for 0 <= x <= 1/2 with w = -ln(1 - x), by the series of Bernoulli numbers.
GSPLAT_INLINE float dilogarithm_series(float w) {
  const float w2 = w * w;
  return w * (1 + w * (-0.25f + w * (1.0f / 36 + w2 * (-1.0f / 3600 + w2 * (1.0f / 211680 - w2 * (1.0f / 10886400))))));
}

// Li2(x) for 0 <= x < 1, given ln(1 - x).
GSPLAT_INLINE float dilogarithm(float x, float log_rest) {
  if (x <= 0.5f) return dilogarithm_series(-log_rest);
  const float log_x = GSPLAT_MATH(logf)(x);
  return 1.64493407f - log_x * log_rest - dilogarithm_series(-log_x);
}

// x with Li2(x) = t, for 0 < t <= Li2(0.99).
GSPLAT_INLINE float inverse_dilogarithm(float t) {
  const float position = t * (kInverseSteps / kLargestDilogarithm);
  const int cell = position < kInverseSteps - 1 ? int(position) : kInverseSteps - 1;
  const float x = kInverse[cell] + (position - float(cell)) * (kInverse[cell + 1] - kInverse[cell]);
  const float log_rest = GSPLAT_MATH(log1pf)(-x);
  return x + (dilogarithm(x, log_rest) - t) * x / log_rest;
}

// ---- Random numbers with a Poisson distribution ----

// ln(k!)
GSPLAT_INLINE double log_factorial(double k) {
  double shift = 1;
  while (k < 10) shift *= ++k;
  const double r = 1 / (k + 1), r2 = r * r, x = k + 1;
  const double stirling = (x - 0.5) * GSPLAT_MATH(log)(x) - x + 0.91893853320467274178 +
                          r * (1.0 / 12 - r2 * (1.0 / 360 - r2 * (1.0 / 1260 - r2 * (1.0 / 1680))));
  return stirling - GSPLAT_MATH(log)(shift);
}

// Draw from a Poisson distribution, exactly up to the rounding of double: by inversion below 30, above by PTRS (Hörmann
// 1993). The numbers come from the counters (n, key, sample, kCountStream) for n = 0, 1, ...
GSPLAT_INLINE int64_t poisson(double rate, uint32_t key, uint32_t sample, const uint32_t seed[2]) {
  if (!(rate > 0)) return 0;
  if (rate < kInversionLimit) {
    uint32_t c[4] = {0, key, sample, kCountStream};
    philox(c, seed[0], seed[1]);
    double left = unit_interval(c[0], c[1]), probability = GSPLAT_MATH(exp)(-rate);
    int64_t k = 0;
    while (left >= probability && k < 400) {
      left -= probability;
      probability *= rate / double(++k);
    }
    return k;
  }
  const double root = GSPLAT_MATH(sqrt)(rate), log_rate = GSPLAT_MATH(log)(rate);
  const double b = 0.931 + 2.53 * root, a = -0.059 + 0.02483 * b;
  const double inverse_alpha = 1.1239 + 1.1328 / (b - 3.4), accepted = 0.9277 - 3.6224 / (b - 2);
  for (uint32_t n = 0;; ++n) {
    uint32_t c[4] = {n, key, sample, kCountStream};
    philox(c, seed[0], seed[1]);
    const double u = unit_interval(c[0], c[1]) - 0.5, v = unit_interval(c[2], c[3]);
    const double us = 0.5 - (u < 0 ? -u : u);
    const double k = GSPLAT_MATH(floor)((2 * a / us + b) * u + rate + 0.43);
    if (us >= 0.07 && v <= accepted) return int64_t(k);
    if (!(k >= 0) || (us < 0.013 && v > us) || k > 1e15) continue;
    if (GSPLAT_MATH(log)(v * inverse_alpha / (a / (us * us) + b)) <= k * log_rate - rate - log_factorial(k)) return int64_t(k);
  }
}

// ---- Projection of splats to the picture ----

// One Gaussian per lane, before projection.
struct Loaded {
  vfloat mean[3], opacity;
  Geometry geometry;
};

GSPLAT_INLINE ProjectionInput projection_input(const Request& view) {
  ProjectionInput in = {};
  in.viewmat = view.viewmat;
  in.intrinsics = view.intrinsics;
  in.width = float(view.width);
  in.height = float(view.height);
  in.eps2d = kBlurPx2;
  in.near_plane = kNearPlane;
  in.far_plane = kFarPlane;
  in.model = CameraModel(view.camera_model);
  return in;
}

// The plane n (x - mean) = 0 with n = Sigma^-1 (mean - camera), as coefficients of 1 / z at pixel (x, y, 1); and the
// largest distance from the centre's z that a fragment may have.
struct Plane {
  vfloat coefficients[3], reach;
};

GSPLAT_INLINE Plane plane_of(const ProjectionInput& in, const Loaded& one, bool rotations) {
  const projection::View<kPinhole> camera(in);
  const Point3 p = camera.to_camera(one.mean);
  const vfloat seen[3] = {p.x, p.y, p.z};
  vfloat m[3], n[3], size;  // the centre from the camera in world axes; the normal
  for (int i = 0; i < 3; ++i) m[i] = camera.w.m[0][i] * seen[0] + camera.w.m[1][i] * seen[1] + camera.w.m[2][i] * seen[2];
  if (rotations) {
    const vfloat* s = one.geometry.scales;
    size = max(max(s[0], s[1]), s[2]);
    vfloat along[3];
    for (int k = 0; k < 3; ++k) {
      const vfloat a = s[(k + 1) % 3] / size, b = s[(k + 2) % 3] / size, weight = a * a * b * b;
      const auto& r = one.geometry.rotation.m;
      along[k] = weight * (r[0][k] * m[0] + r[1][k] * m[1] + r[2][k] * m[2]);
    }
    for (int i = 0; i < 3; ++i) {
      const auto& r = one.geometry.rotation.m[i];
      n[i] = r[0] * along[0] + r[1] * along[1] + r[2] * along[2];
    }
  } else {
    // Extent of the splat from its inverse covariance; the adjugate is proportional to the inverse.
    size = sqrt(one.geometry.sigma.v[0] + one.geometry.sigma.v[3] + one.geometry.sigma.v[5]);
    vfloat c[6];
    for (int k = 0; k < 6; ++k) c[k] = one.geometry.sigma.v[k] / (size * size);
    const vfloat xx = c[3] * c[5] - c[4] * c[4], xy = c[2] * c[4] - c[1] * c[5], xz = c[1] * c[4] - c[2] * c[3];
    const vfloat yy = c[0] * c[5] - c[2] * c[2], yz = c[1] * c[2] - c[0] * c[4], zz = c[0] * c[3] - c[1] * c[1];
    n[0] = xx * m[0] + xy * m[1] + xz * m[2];
    n[1] = xy * m[0] + yy * m[1] + yz * m[2];
    n[2] = xz * m[0] + yz * m[1] + zz * m[2];
  }
  const vfloat scale = 1.0f / (n[0] * m[0] + n[1] * m[1] + n[2] * m[2]);
  vfloat d[3];  // in camera axes
  for (int r = 0; r < 3; ++r) d[r] = scale * (camera.w.m[r][0] * n[0] + camera.w.m[r][1] * n[1] + camera.w.m[r][2] * n[2]);
  const vfloat x = d[0] / camera.k.fx, y = d[1] / camera.k.fy;
  return {{x, y, d[2] - x * camera.k.cx - y * camera.k.cy}, 3.0f * size};
}

// Splat of one lane after projection: its position, shape and opacity in the picture.
struct Lane {
  float u, v, z, conic[3], half[2], determinant, opacity, plane[3], reach;
};

// Compute the box of the picture's sub-pixels whose centres are at most half[0] and half[1] from the splat's centre, with
// a small margin. False if it is empty.
GSPLAT_INLINE bool box_of(const Request& view, const Lane& lane, Splat& out, int64_t& fragments) {
  const float s = float(view.supersampling);
  const float centre[2] = {lane.u, lane.v};
  const int32_t most[2] = {view.columns() - 1, view.rows() - 1};
  int32_t first[2], last[2];
  for (int k = 0; k < 2; ++k) {
    const float half = lane.half[k] + kBoxMarginPx + 1e-6f * (centre[k] < 0 ? -centre[k] : centre[k]);
    const float low = GSPLAT_MATH(ceilf)((centre[k] - half) * s - 0.5f),
                high = GSPLAT_MATH(floorf)((centre[k] + half) * s - 0.5f);
    first[k] = low > 0 ? (low < float(most[k]) ? int32_t(low) : most[k]) : 0;
    last[k] = high < float(most[k]) ? (high > 0 ? int32_t(high) : 0) : most[k];
    if (!(high >= 0) || !(low <= float(most[k])) || last[k] < first[k]) return false;
  }
  const uint32_t columns = uint32_t(last[0] - first[0]), rows = uint32_t(last[1] - first[1]);
  out.corner = uint32_t(first[0]) | uint32_t(first[1]) << 16;
  out.size = columns | rows << 16;
  fragments = (int64_t(columns) + 1) * (int64_t(rows) + 1);
  return true;
}

// Complete a splat; return false if it has no fragment or point. `sample` is the number of the sample whose points are
// drawn.
GSPLAT_INLINE bool finish_splat(const Request& view, const Lane& lane, uint32_t row, uint32_t key, Splat& out) {
  int64_t fragments;
  if (!box_of(view, lane, out, fragments)) return false;
  out.u = lane.u;
  out.v = lane.v;
  out.z = lane.z;
  for (int k = 0; k < 3; ++k) out.conic[k] = 0.5f * kLog2e * lane.conic[k];
  out.row = row;
  out.key = key;
  out.count = uint32_t(fragments);
  if (view.method == kFragments) {
    out.log2_opacity = GSPLAT_MATH(log2f)(lane.opacity);
    for (int k = 0; k < 3; ++k) out.plane[k] = lane.plane[k];
    out.extra = lane.reach;
    return true;
  }
  const float opacity = lane.opacity < gsplat::kMaxAlpha ? lane.opacity : gsplat::kMaxAlpha;
  out.log2_opacity = GSPLAT_MATH(log2f)(opacity);
  out.extra = dilogarithm(opacity, GSPLAT_MATH(log1pf)(-opacity));
  const float s = float(view.supersampling);
  const float rate = s * s * 6.28318531f * (out.extra - kCutoffDilogarithm) * GSPLAT_MATH(sqrtf)(lane.determinant);
  if (!(rate <= kPointsPerFragment * float(fragments)) || !(rate < kMostPoints)) {
    out.extra = -1;
    return true;
  }
  const int64_t points = poisson(double(rate), key, view.sample, view.seed);
  if (points == 0) return false;
  out.count = uint32_t(points < 0xffffffff ? points : 0xffffffff);
  out.plane[0] = GSPLAT_MATH(sqrtf)(lane.conic[0]);
  out.plane[1] = lane.conic[1] / out.plane[0];
  out.plane[2] = 1.0f / GSPLAT_MATH(sqrtf)(lane.determinant * lane.conic[0]);
  return true;
}

// ---- Random points of a splat ----

// Return the sub-pixel of point `number` of a splat, or -1 outside the picture.
GSPLAT_INLINE int64_t point_of(const Request& view, const Splat& splat, uint32_t number) {
  uint32_t c[4] = {number, splat.key, view.sample, kPointStream};
  philox(c, view.seed[0], view.seed[1]);
  const float t = kCutoffDilogarithm + (1.0f - unit_interval(c[0])) * (splat.extra - kCutoffDilogarithm);
  const float log_share = GSPLAT_MATH(log2f)(inverse_dilogarithm(t)) - splat.log2_opacity;
  const float radius = GSPLAT_MATH(sqrtf)(log_share < 0 ? -1.38629436f * log_share : 0);
  const float angle = 6.28318531f * unit_interval(c[1]);
  const float y = radius * GSPLAT_MATH(sinf)(angle) / splat.plane[2];
  const float x = (radius * GSPLAT_MATH(cosf)(angle) - splat.plane[1] * y) / splat.plane[0];
  const float s = float(view.supersampling);
  const float column = GSPLAT_MATH(floorf)((splat.u + x) * s), row = GSPLAT_MATH(floorf)((splat.v + y) * s);
  if (!(column >= 0 && column < float(view.columns()) && row >= 0 && row < float(view.rows()))) return -1;
  return int64_t(row) * view.columns() + int64_t(column);
}

// True if the splat has a point in the sub-pixel: a Poisson number of candidates of the largest density, each of which
// is accepted in proportion to the density at its place.
GSPLAT_INLINE bool has_point(const Request& view, const Splat& splat, int32_t column, int32_t row) {
  const uint32_t subpixel = uint32_t(int64_t(row) * view.columns() + column);
  const float opacity = GSPLAT_MATH(exp2f)(splat.log2_opacity);
  const float most = -GSPLAT_MATH(log1pf)(-opacity), inverse = 1.0f / float(view.supersampling);
  uint32_t first[4] = {subpixel, splat.key, view.sample, kFragmentStream};
  philox(first, view.seed[0], view.seed[1]);
  float left = unit_interval(first[0]), probability = GSPLAT_MATH(expf)(-most);
  for (uint32_t k = 1; left >= probability && k < 100; ++k) {
    left -= probability;
    probability *= most / float(k);
    uint32_t c[4] = {subpixel, splat.key, view.sample, kFragmentStream | k};
    philox(c, view.seed[0], view.seed[1]);
    const float dx = (float(column) + unit_interval(c[0])) * inverse - splat.u;
    const float dy = (float(row) + unit_interval(c[1])) * inverse - splat.v;
    const float power = splat.log2_opacity - (splat.conic[0] * dx * dx + 2 * splat.conic[1] * dx * dy + splat.conic[2] * dy * dy);
    if (power < gsplat::kLog2AlphaCutoff) continue;
    if (unit_interval(c[2]) * most < -GSPLAT_MATH(log1pf)(-GSPLAT_MATH(exp2f)(power))) return true;
  }
  return false;
}

}  // namespace GSPLAT_ISA::stochastic
