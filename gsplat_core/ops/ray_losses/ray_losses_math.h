// Terms of one pixel and their derivatives, shared by both devices.
#pragma once

#include "ray_losses.h"
#include "simd.h"

namespace GSPLAT_ISA::ray_losses {

using namespace gsplat::ray_losses;

// Term of a pixel, its derivative by the depth, and the inverse of the known depth; zeros if the pixel is not compared.
struct DepthTerm {
  float off, slope, inverse;
};
GSPLAT_INLINE DepthTerm depth_term(const DepthLoss& in, int64_t at) {
  const float depth = in.depths[at], known = in.known[at];
  if (!(in.tissue[at] != 0 && depth > 0 && known > 0)) return {0, 0, 0};
  const float own = 1.0f / depth, inverse = 1.0f / known, off = own - inverse;
  const float slope = off > 0 ? -own * own : off < 0 ? own * own : 0.0f;
  return {off < 0 ? -off : off, slope, inverse};
}

// Return true if the surface is known and without a jump at a pixel and both of its neighbours.
GSPLAT_INLINE bool is_smooth(float depth, float ahead, float behind) {
  const float most = kLargestJump * depth, up = ahead - depth, down = behind - depth;
  return ahead > 0 && behind > 0 && up <= most && -up <= most && down <= most && -down <= most;
}

// Central differences of the depth along an axis at 1 px, averaged with those at 2 px if `wide`.
struct Differences {
  float slope, mean;
  bool known, wide;
};
GSPLAT_INLINE Differences differences_at(const float* depths, int64_t at, int64_t step, int index, int length) {
  Differences d = {0, 0, false, false};
  if (index < 1 || index + 1 >= length) return d;
  const float depth = depths[at], ahead = depths[at + step], behind = depths[at - step];
  d.known = is_smooth(depth, ahead, behind);
  d.slope = 0.5f * (ahead - behind);
  d.mean = 0.5f * (ahead + behind);
  if (!d.known || index < 2 || index + 2 >= length) return d;
  const float far_ahead = depths[at + 2 * step], far_behind = depths[at - 2 * step];
  d.wide = is_smooth(depth, far_ahead, far_behind);
  if (d.wide) {
    d.slope = 0.5f * (d.slope + 0.25f * (far_ahead - far_behind));
    d.mean = 0.5f * (d.mean + 0.5f * (far_ahead + far_behind));
  }
  return d;
}

// Return the term of a pixel and write its derivatives. The normal is that of (p, q, -toward), the cross product of the
// derivatives of depth * (u, v, 1) by the pixel coordinates, divided by a positive number.
GSPLAT_INLINE float write_normal_term(const NormalLoss& in, int x, int y) {
  const int64_t at = int64_t(y) * in.width + x;
  float *const changes = in.changes + 4 * at, *const v_normal = in.v_normals + 3 * at;
  const Differences across = differences_at(in.depths, at, 1, x, in.width);
  const Differences down = differences_at(in.depths, at, in.width, y, in.height);
  if (!(in.tissue[at] != 0 && across.known && down.known && in.camera_model != kFisheye)) {
    in.bits[at] = 0;
    for (int i = 0; i < 4; ++i) changes[i] = 0;
    for (int i = 0; i < 3; ++i) v_normal[i] = 0;
    return 0;
  }
  in.bits[at] = uint8_t(kCompared | (across.wide ? kWideX : 0) | (down.wide ? kWideY : 0));
  const bool perspective = in.camera_model == kPinhole;
  const float fx = in.K[0], fy = in.K[4];
  const float u = perspective ? (float(x) + 0.5f - in.K[2]) / fx : 0.0f,
              v = perspective ? (float(y) + 0.5f - in.K[5]) / fy : 0.0f;
  const float p_slope = perspective ? fx / across.mean : fx, q_slope = perspective ? fy / down.mean : fy;
  const float p = p_slope * across.slope, q = q_slope * down.slope, toward = 1.0f + u * p + v * q;
  const float scale = 1.0f / __builtin_sqrtf(p * p + q * q + toward * toward);
  const float normal[3] = {p * scale, q * scale, -toward * scale};
  const float* const blended = in.normals + 3 * at;
  const float along = blended[0] * normal[0] + blended[1] * normal[1] + blended[2] * normal[2];
  float w[3];  // derivative of the term by (p, q, -toward)
  for (int i = 0; i < 3; ++i) {
    w[i] = scale * (along * normal[i] - blended[i]);
    v_normal[i] = -normal[i];
  }
  const float v_p = w[0] - u * w[2], v_q = w[1] - v * w[2];
  changes[0] = v_p * p_slope;
  changes[1] = perspective ? -v_p * p / across.mean : 0.0f;
  changes[2] = v_q * q_slope;
  changes[3] = perspective ? -v_q * q / down.mean : 0.0f;
  return in.alphas[at] - along;
}

// Sum the derivatives by a depth of the terms along one axis. `changes`: those by slope and mean, of the axis.
GSPLAT_INLINE float along_axis(const float* changes, const uint8_t* bits, uint8_t wide, int64_t at, int64_t step, int index,
                               int length) {
  float sum = 0;
  for (int offset = -2; offset <= 2; ++offset) {
    if (offset == 0 || index + offset < 0 || index + offset >= length) continue;
    const int64_t term = at + offset * step;
    const bool is_wide = (bits[term] & wide) != 0, is_far = offset == 2 || offset == -2;
    if (is_far && !is_wide) continue;
    // The slope is (ahead - behind) / (2 distance), and a pixel with a negative offset has this depth ahead.
    const float by_slope = -1.0f / float(2 * offset), share = is_wide ? 0.5f : 1.0f;
    sum += share * (by_slope * changes[4 * term] + 0.5f * changes[4 * term + 1]);
  }
  return sum;
}

// Write the gradients of the sum of all terms by a pixel's depth, alpha and normal, times `scale`.
GSPLAT_INLINE void write_normal_gradient(const NormalLoss& in, float scale, int x, int y) {
  const int64_t at = int64_t(y) * in.width + x;
  const float by_depth = along_axis(in.changes, in.bits, kWideX, at, 1, x, in.width) +
                         along_axis(in.changes + 2, in.bits, kWideY, at, in.width, y, in.height);
  in.v_depths[at] = scale * by_depth;
  in.v_alphas[at] = (in.bits[at] & kCompared) != 0 ? scale : 0.0f;
  for (int i = 0; i < 3; ++i) in.v_normals[3 * at + i] *= scale;
}

}  // namespace GSPLAT_ISA::ray_losses
