// Normal of one pixel and its derivatives, shared by both devices.
//
// A point is depth * (x, y, 1) in camera axes. With the depths of the four neighbours, the cross product of the differences
// of points downwards and across is
//   (p a, q b, -(x p a + y q b + a b)), p = right - left, q = below - above, a = (below + above) / fy, b = (right + left) / fx.
// The cofactor matrix of the upper left part of to_world turns it into world axes.
#pragma once

#include "depth_to_normal.h"
#include "simd.h"

namespace GSPLAT_ISA::depth_to_normal {

using namespace gsplat::depth_to_normal;

struct Vector {
  float x, y, z;
};

struct View {
  float turn[9];  // cofactor matrix
  float center_x, center_y, per_fx, per_fy;
};

GSPLAT_INLINE View view_of(const Maps& maps, int64_t image) {
  const float* const m = maps.to_world + 16 * image;
  const float* const K = maps.K + 9 * image;
  View v;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
      v.turn[3 * i + j] = m[4 * i1 + j1] * m[4 * i2 + j2] - m[4 * i1 + j2] * m[4 * i2 + j1];
    }
  v.center_x = K[2], v.center_y = K[5], v.per_fx = 1.0f / K[0], v.per_fy = 1.0f / K[4];
  return v;
}

struct Slopes {
  float x, y;        // of the pixel in the plane at depth 1
  float p, q, a, b;  // of the formula above
};

GSPLAT_INLINE bool is_inner(const Maps& maps, int x, int y) {
  return x > 0 && x + 1 < maps.width && y > 0 && y + 1 < maps.height;
}

// The slopes at an inner pixel of the image that starts at `depths`.
GSPLAT_INLINE Slopes slopes_at(const Maps& maps, const View& view, const float* depths, int x, int y) {
  const float* const at = depths + int64_t(y) * maps.width + x;
  const float right = at[1], left = at[-1], below = at[maps.width], above = at[-int64_t(maps.width)];
  return {(float(x) + 0.5f - view.center_x) * view.per_fx,
          (float(y) + 0.5f - view.center_y) * view.per_fy,
          right - left,
          below - above,
          (below + above) * view.per_fy,
          (right + left) * view.per_fx};
}

// The cross product of the differences in world axes.
GSPLAT_INLINE Vector cross_at(const View& view, const Slopes& s) {
  const float cx = s.p * s.a, cy = s.q * s.b, cz = -(s.x * cx + s.y * cy + s.a * s.b);
  const float* const t = view.turn;
  return {t[0] * cx + t[1] * cy + t[2] * cz, t[3] * cx + t[4] * cy + t[5] * cz, t[6] * cx + t[7] * cy + t[8] * cz};
}

// Return 1 / length, or 0 for a vector without a direction.
GSPLAT_INLINE float per_length(const Vector& u) {
  const float length = sqrtf(u.x * u.x + u.y * u.y + u.z * u.z);
  return length > kLeastLength ? 1.0f / length : length <= kLeastLength ? 0.0f : length;  // a NaN stays
}

GSPLAT_INLINE void write_normal(const Maps& maps, const View& view, int64_t image, int x, int y, float* normals) {
  const int64_t first = image * maps.height * maps.width;
  float* const out = normals + 3 * (first + int64_t(y) * maps.width + x);
  Vector n = {0, 0, 0};
  if (is_inner(maps, x, y)) {
    const Vector u = cross_at(view, slopes_at(maps, view, maps.depths + first, x, y));
    const float scale = per_length(u);
    n = {u.x * scale, u.y * scale, u.z * scale};
  }
  out[0] = n.x, out[1] = n.y, out[2] = n.z;
}

// Derivatives of the weighted normal of one pixel by p, q, a and b.
struct Change {
  float p, q, a, b;
};

GSPLAT_INLINE Change change_at(const Maps& maps, const View& view, int64_t first, int x, int y, const float* v_normals) {
  if (!is_inner(maps, x, y)) return {0, 0, 0, 0};
  const Slopes s = slopes_at(maps, view, maps.depths + first, x, y);
  const Vector u = cross_at(view, s);
  const float scale = per_length(u);
  const float* const v = v_normals + 3 * (first + int64_t(y) * maps.width + x);
  const Vector n = {u.x * scale, u.y * scale, u.z * scale};
  const float along = n.x * v[0] + n.y * v[1] + n.z * v[2];
  const Vector w = {(v[0] - n.x * along) * scale, (v[1] - n.y * along) * scale, (v[2] - n.z * along) * scale};
  const float* const t = view.turn;
  const float by_z = t[2] * w.x + t[5] * w.y + t[8] * w.z;
  const float by_x = t[0] * w.x + t[3] * w.y + t[6] * w.z - s.x * by_z;
  const float by_y = t[1] * w.x + t[4] * w.y + t[7] * w.z - s.y * by_z;
  return {s.a * by_x, s.b * by_y, s.p * by_x - s.b * by_z, s.q * by_y - s.a * by_z};
}

GSPLAT_INLINE void write_gradient(const Maps& maps, const View& view, int64_t image, int x, int y, const float* v_normals,
                                  float* v_depths) {
  const int64_t first = image * maps.height * maps.width;
  const Change left = change_at(maps, view, first, x - 1, y, v_normals),
               right = change_at(maps, view, first, x + 1, y, v_normals);
  const Change above = change_at(maps, view, first, x, y - 1, v_normals),
               below = change_at(maps, view, first, x, y + 1, v_normals);
  v_depths[first + int64_t(y) * maps.width + x] =
      view.per_fx * (left.b + right.b) + left.p - right.p + view.per_fy * (above.a + below.a) + above.q - below.q;
}

}  // namespace GSPLAT_ISA::depth_to_normal
