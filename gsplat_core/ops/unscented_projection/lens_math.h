// Lens and rolling shutter of one camera, one point per lane: pixel of a world point, and its derivatives.
#pragma once

#include "simd.h"
#include "unscented_projection.h"

namespace GSPLAT_ISA::unscented_projection {

using namespace gsplat::unscented_projection;

struct Point3 {
  vfloat x, y, z;
};

// Pixel of a point in camera axes.
struct Pixel {
  vfloat u, v;
  vint seen;  // in front of the camera, and where the lens does not fold over
  vfloat j[2][3];
};

GSPLAT_INLINE vfloat dot3(const float* a, const Point3& p) { return a[0] * p.x + a[1] * p.y + a[2] * p.z; }
GSPLAT_INLINE Point3 cross(const float* a, const Point3& p) {
  return {a[1] * p.z - a[2] * p.y, a[2] * p.x - a[0] * p.z, a[0] * p.y - a[1] * p.x};
}

// Rotate by the rotation vector `turn` times `time` (Rodrigues' formula). sin and cos are polynomials of a quarter of the
// angle, up to 2 pi.
GSPLAT_INLINE Point3 rotated(const float* turn, vfloat time, const Point3& p) {
  const vfloat h = time * time * ((turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2]) * 0.0625f);
  const vfloat s1 = 1 + h * (-1.f / 6 + h * (1.f / 120 + h * (-1.f / 5040 + h * (1.f / 362880 + h * (-1.f / 39916800)))));
  const vfloat c1 =
      1 + h * (-0.5f + h * (1.f / 24 + h * (-1.f / 720 + h * (1.f / 40320 + h * (-1.f / 3628800 + h * (1.f / 479001600))))));
  const vfloat s2 = s1 * c1, c2 = 1 - 2 * h * s1 * s1;
  const vfloat first = s2 * c2 * time, second = 0.5f * s2 * s2 * time * time;
  const Point3 once = cross(turn, p), twice = cross(turn, once);
  return {p.x + first * once.x + second * twice.x, p.y + first * once.y + second * twice.y,
          p.z + first * once.z + second * twice.z};
}

struct Lens {
  const float* c;  // a row of `cameras`
  LensModel model;
  ShutterKind shutter;
  bool distorted;
  float row_time;  // time per pixel along the read-out

  GSPLAT_METHOD Lens(const Inputs& in, int64_t image)
      : c(in.cameras + image * kCameraColumns), model(in.model), shutter(in.shutter), distorted(in.distorted) {
    const float length = horizontal() ? in.width : in.height;
    row_time = 1 / (length > 2 ? length - 1 : 1);
  }
  GSPLAT_METHOD bool rolls() const { return shutter != kGlobal; }
  GSPLAT_METHOD bool horizontal() const { return shutter == kLeftToRight || shutter == kRightToLeft; }
  GSPLAT_METHOD bool backward() const { return shutter == kBottomToTop || shutter == kRightToLeft; }

  GSPLAT_METHOD vfloat time_of(vfloat u, vfloat v) const {
    const vfloat time = ((horizontal() ? u : v) - 0.5f) * row_time;
    return min(max(backward() ? 1 - time : time, splat(-1.0f)), splat(2.0f));
  }

  // Rotate a world point into the camera's axes at a read-out time, without translation.
  GSPLAT_METHOD Point3 turned(const Point3& world, vfloat time) const {
    const float* w = c + kRotation;
    const Point3 p = {dot3(w, world), dot3(w + 3, world), dot3(w + 6, world)};
    return rolls() ? rotated(c + kTurn, time, p) : p;
  }
  GSPLAT_METHOD Point3 moved(const Point3& p, vfloat time) const {
    const float *t = c + kTranslation, *s = c + kShift;
    if (!rolls()) return {p.x + t[0], p.y + t[1], p.z + t[2]};
    return {p.x + (t[0] + s[0] * time), p.y + (t[1] + s[1] * time), p.z + (t[2] + s[2] * time)};
  }
  // Rotate a direction from the camera's axes at a read-out time to the world's: the transpose of `turned`.
  GSPLAT_METHOD Point3 to_world(const Point3& v, vfloat time) const {
    const Point3 p = rolls() ? rotated(c + kTurn, -time, v) : v;
    const float* w = c + kRotation;
    return {w[0] * p.x + w[3] * p.y + w[6] * p.z, w[1] * p.x + w[4] * p.y + w[7] * p.z, w[2] * p.x + w[5] * p.y + w[8] * p.z};
  }

  GSPLAT_METHOD Pixel pixel_of(Point3 p) const {
    const vfloat none = vfloat{}, one = splat(1.0f);
    const float fx = c[kFocal], fy = c[kFocal + 1], cx = c[kCenter], cy = c[kCenter + 1];
    if (model == kOrtho)
      return {fx * p.x + cx,
              fy * p.y + cy,
              (p.x - p.x == 0.0f) & (p.y - p.y == 0.0f) & (p.z - p.z == 0.0f),
              {{splat(fx), none, none}, {none, splat(fy), none}}};
    vint seen = p.z > 0.0f;
    p = {select(seen, p.x, none), select(seen, p.y, none), select(seen, p.z, one)};
    if (model == kFisheye) {
      const float* k = c + kRadial;
      const vfloat r2 = p.x * p.x + p.y * p.y, w = 1.0f / (r2 + p.z * p.z);
      const vint off_axis = r2 > 0.0f;
      const vfloat r = sqrt(select(off_axis, r2, one)), inverse = 1.0f / r;
      const vfloat angle = select(off_axis, atan2(r, p.z), none), squared = angle * angle;
      seen &= angle < c[kLimit];
      const vfloat bent = angle * (1 + squared * (k[0] + squared * (k[1] + squared * (k[2] + squared * k[3]))));
      const vfloat slope = 1 + squared * (3 * k[0] + squared * (5 * k[1] + squared * (7 * k[2] + squared * (9 * k[3]))));
      const vfloat s = select(off_axis, bent * inverse, 1.0f / p.z);
      const vfloat ex = select(off_axis, p.x * inverse, none), ey = select(off_axis, p.y * inverse, none);
      const vfloat d = slope * p.z * w - s, back = -slope * w;
      return {fx * p.x * s + cx,
              fy * p.y * s + cy,
              seen,
              {{fx * (s + d * ex * ex), fx * d * ex * ey, fx * back * p.x},
               {fy * d * ex * ey, fy * (s + d * ey * ey), fy * back * p.y}}};
    }
    const vfloat inverse = 1.0f / p.z;
    vfloat x = p.x * inverse, y = p.y * inverse;
    const vfloat r2 = x * x + y * y;
    seen &= r2 < c[kLimit];
    vfloat across = x, down = y, xx = one, xy = none, yx = none, yy = one;
    if (distorted) {
      const float *k = c + kRadial, *t = c + kTangential, *s = c + kPrism;
      const vfloat over = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[2])), under = 1 + r2 * (k[3] + r2 * (k[4] + r2 * k[5]));
      const vfloat scale = over / under;
      const vfloat slope = (k[0] + r2 * (2 * k[1] + 3 * k[2] * r2) - scale * (k[3] + r2 * (2 * k[4] + 3 * k[5] * r2))) / under;
      across = x * scale + 2 * t[0] * x * y + t[1] * (r2 + 2 * x * x) + r2 * (s[0] + s[1] * r2);
      down = y * scale + t[0] * (r2 + 2 * y * y) + 2 * t[1] * x * y + r2 * (s[2] + s[3] * r2);
      const vfloat both = 2 * x * y * slope + 2 * (t[0] * x + t[1] * y);
      const vfloat right = 2 * (s[0] + 2 * s[1] * r2), below = 2 * (s[2] + 2 * s[3] * r2);
      xx = scale + 2 * x * x * slope + 2 * t[0] * y + 6 * t[1] * x + x * right;
      xy = both + y * right;
      yx = both + x * below;
      yy = scale + 2 * y * y * slope + 6 * t[0] * y + 2 * t[1] * x + y * below;
      seen &= xx * yy - xy * yx > 0.0f;
    }
    return {fx * across + cx,
            fy * down + cy,
            seen,
            {{fx * xx * inverse, fx * xy * inverse, -fx * (xx * x + xy * y) * inverse},
             {fy * yx * inverse, fy * yy * inverse, -fy * (yx * x + yy * y) * inverse}}};
  }

  // Compute the pixel of a world point and the time of its read-out by the rolling shutter.
  GSPLAT_METHOD Pixel pixel_of_world(const Point3& world, vfloat& time) const {
    time = splat(0.5f);
    Pixel pixel = pixel_of(moved(turned(world, time), time));
    if (rolls())
      for (int step = 0; step < 10; ++step) {
        time = time_of(pixel.u, pixel.v);
        pixel = pixel_of(moved(turned(world, time), time));
      }
    return pixel;
  }

  // Gradient of a world point from that of its pixel. The time of the read-out depends on the pixel (implicit function).
  GSPLAT_METHOD Point3 world_gradient(const Point3& world, const Pixel& pixel, vfloat time, vfloat v_u, vfloat v_v) const {
    const auto& j = pixel.j;
    if (rolls()) {
      const Point3 p = turned(world, time), rate = cross(c + kTurn, p);
      const float* s = c + kShift;
      const Point3 speed = {rate.x + s[0], rate.y + s[1], rate.z + s[2]};
      const vfloat f_u = j[0][0] * speed.x + j[0][1] * speed.y + j[0][2] * speed.z;
      const vfloat f_v = j[1][0] * speed.x + j[1][1] * speed.y + j[1][2] * speed.z;
      const float step = backward() ? -row_time : row_time;
      const vint free = (time > -1.0f) & (time < 2.0f);
      const vfloat along = select(free, (f_u * v_u + f_v * v_v) / (1 - step * (horizontal() ? f_u : f_v)) * step, vfloat{});
      if (horizontal())
        v_u += along;
      else
        v_v += along;
    }
    const Point3 v = {j[0][0] * v_u + j[1][0] * v_v, j[0][1] * v_u + j[1][1] * v_v, j[0][2] * v_u + j[1][2] * v_v};
    return to_world(v, time);
  }
};

}  // namespace GSPLAT_ISA::unscented_projection
