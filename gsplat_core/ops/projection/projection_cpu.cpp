#include "../covariance/covariance_math.h"
#include "camera_models.h"
#include "projection.h"
#include "rows.h"
#include "simd.h"

namespace GSPLAT_ISA {

constexpr float kAlphaCutoff = 1.0f / 255.0f;
constexpr float kMaxExtentSigmas = 3.33f;
constexpr float kMinCompensation = 0.005f;
constexpr float kMaxRadius = 1e9f;
constexpr float kHuge = 1e30f;  // beyond this a number is taken for infinite: its square is

GSPLAT_INLINE vfloat ceil(vfloat x) {
  for (int i = 0; i < kLanes; ++i) x[i] = __builtin_ceilf(x[i]);
  return x;
}
// False for NaN too.
GSPLAT_INLINE vint finite(vfloat x) { return (x > -kHuge) & (x < kHuge); }

// What forward and backward both need about up to kLanes Gaussians in one camera.
template <CameraModel model>
struct View {
  Matrix3 w;  // rotation of the camera, the same in every lane
  vfloat translation[3];
  Intrinsics k;

  explicit inline __attribute__((always_inline)) View(const ProjectionInput& in) {
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) w.m[i][j] = splat(in.viewmat[4 * i + j]);
      translation[i] = splat(in.viewmat[4 * i + 3]);
    }
    k = intrinsics_of(in.intrinsics, in.width, in.height);
  }

  inline __attribute__((always_inline)) Point3 to_camera(const vfloat m[3]) const {
    vfloat p[3];
    for (int i = 0; i < 3; ++i) p[i] = w.m[i][0] * m[0] + w.m[i][1] * m[1] + w.m[i][2] * m[2] + translation[i];
    return {p[0], p[1], p[2]};
  }
};

struct Geometry {
  Symmetric3 sigma;
  vint valid;
  UnitQuat quat;
  Matrix3 rotation;
  vfloat scales[3];
};

GSPLAT_INLINE Geometry load_geometry(const ProjectionInput& in, int64_t first, int count) {
  Geometry g;
  if (in.covars != nullptr) {
    load_rows<6>(in.covars, first, count, g.sigma.v);
    g.valid = splat_int(-1);
  } else {
    vfloat q[4];
    load_rows<4>(in.quats, first, count, q);
    load_rows<3>(in.scales, first, count, g.scales);
    g.quat = normalise(q);
    g.rotation = rotation_of(g.quat);
    g.sigma = outer_square(g.rotation, g.scales);
    g.valid = g.quat.valid;
  }
  for (int i = 0; i < 6; ++i) g.valid &= finite(g.sigma.v[i]);
  return g;
}

struct Ellipse {
  vfloat affine[2][3];  // A = J W
  vfloat half[2][3];    // A Sigma
  vfloat a0, b, c0;     // A Sigma A^T, not blurred
};

template <CameraModel model>
GSPLAT_INLINE Ellipse ellipse_of(const View<model>& view, const ImagePoint& image, const Symmetric3& s) {
  Ellipse e;
  const vfloat full[3][3] = {{s.v[0], s.v[1], s.v[2]}, {s.v[1], s.v[3], s.v[4]}, {s.v[2], s.v[4], s.v[5]}};
  for (int r = 0; r < 2; ++r) {
    for (int c = 0; c < 3; ++c)
      e.affine[r][c] = image.j[r][0] * view.w.m[0][c] + image.j[r][1] * view.w.m[1][c] + image.j[r][2] * view.w.m[2][c];
    for (int c = 0; c < 3; ++c)
      e.half[r][c] = e.affine[r][0] * full[0][c] + e.affine[r][1] * full[1][c] + e.affine[r][2] * full[2][c];
  }
  const auto dot = [&](int r, int c) {
    return e.half[r][0] * e.affine[c][0] + e.half[r][1] * e.affine[c][1] + e.half[r][2] * e.affine[c][2];
  };
  e.a0 = dot(0, 0);
  e.b = dot(0, 1);
  e.c0 = dot(1, 1);
  return e;
}

GSPLAT_INLINE vfloat compensation_of(const Ellipse& e, vfloat det) {
  return sqrt(max((e.a0 * e.c0 - e.b * e.b) / det, splat(kMinCompensation * kMinCompensation)));
}

template <CameraModel model>
static void forward_model(const ProjectionInput& in, const ProjectionOutput& out, int64_t begin, int64_t end) {
  const View<model> view(in);
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    vfloat mean[3];
    load_rows<3>(in.means, first, count, mean);
    const Point3 p = view.to_camera(mean);
    vint valid = (p.z >= in.near_plane) & (p.z <= in.far_plane) & finite(p.x) & finite(p.y) & finite(p.z);
    const Geometry geometry = load_geometry(in, first, count);
    valid &= geometry.valid;
    const ImagePoint image = Projector<model>::forward(view.k, p);
    const Ellipse e = ellipse_of(view, image, geometry.sigma);
    const vfloat a = e.a0 + in.eps2d, c = e.c0 + in.eps2d;
    const vfloat det = a * c - e.b * e.b;
    valid &= (det > 0) & (det < kHuge) & finite(image.u) & finite(image.v);
    const vfloat inverse = 1.0f / det;
    const vfloat conic[3] = {c * inverse, -e.b * inverse, a * inverse};
    valid &= finite(conic[0]) & finite(conic[1]) & finite(conic[2]);

    vfloat compensation = vfloat{}, extent = splat(kMaxExtentSigmas);
    if (out.compensations != nullptr) compensation = compensation_of(e, det);
    if (in.opacities != nullptr) {
      vfloat opacity;
      load_rows<1>(in.opacities, first, count, &opacity);
      if (out.compensations != nullptr) opacity *= compensation;
      valid &= (opacity >= kAlphaCutoff) & finite(opacity);
      // 2 ln(o / cutoff) = 2 ln 2 log2(o / cutoff)
      const vfloat ratio = select(valid, opacity * (1.0f / kAlphaCutoff), splat(1.0f));
      extent = min(extent, sqrt(max(1.38629436f * log2(ratio), vfloat{})));
    }
    const vfloat rx = min(ceil(extent * sqrt(max(a, vfloat{}))), splat(kMaxRadius));
    const vfloat ry = min(ceil(extent * sqrt(max(c, vfloat{}))), splat(kMaxRadius));
    valid &= (rx > in.radius_clip) | (ry > in.radius_clip);
    valid &= (image.u + rx > 0) & (image.u - rx < in.width) & (image.v + ry > 0) & (image.v - ry < in.height);

    const vfloat none = vfloat{};
    const vint radii[2] = {__builtin_convertvector(select(valid, rx, none), vint),
                           __builtin_convertvector(select(valid, ry, none), vint)};
    const vfloat radii_bits[2] = {(vfloat)radii[0], (vfloat)radii[1]};
    store_rows<2>(reinterpret_cast<float*>(out.radii), first, count, radii_bits);
    const vfloat means2d[2] = {select(valid, image.u, none), select(valid, image.v, none)};
    store_rows<2>(out.means2d, first, count, means2d);
    const vfloat depth = select(valid, p.z, none);
    store_rows<1>(out.depths, first, count, &depth);
    const vfloat conics[3] = {select(valid, conic[0], none), select(valid, conic[1], none), select(valid, conic[2], none)};
    store_rows<3>(out.conics, first, count, conics);
    if (out.compensations != nullptr) {
      compensation = select(valid, compensation, none);
      store_rows<1>(out.compensations, first, count, &compensation);
    }
  }
}

template <int K>
GSPLAT_INLINE void write_gradient(float* p, int64_t first, int count, vint valid, vfloat* v, bool accumulate) {
  for (int k = 0; k < K; ++k) v[k] = select(valid, v[k], vfloat{});
  if (accumulate)
    add_rows<K>(p, first, count, v);
  else
    store_rows<K>(p, first, count, v);
}

// Gradient of the blurred 2D covariance, as a symmetric matrix (xx, xy, yy), from those of its inverse and compensation.
GSPLAT_INLINE void covariance2d_gradient(const Ellipse& e, float eps2d, const vfloat v_conic[3], bool compensate,
                                         vfloat v_compensation, vfloat g[3]) {
  const vfloat a = e.a0 + eps2d, c = e.c0 + eps2d, b = e.b;
  const vfloat det = a * c - b * b, inverse = 1.0f / det;
  const vfloat x = c * inverse, y = -b * inverse, z = a * inverse;  // the conic X; the gradient is -X V X
  const vfloat v0 = v_conic[0], v1 = 0.5f * v_conic[1], v2 = v_conic[2];
  const vfloat m00 = v0 * x + v1 * y, m01 = v0 * y + v1 * z, m10 = v1 * x + v2 * y, m11 = v1 * y + v2 * z;  // V X
  g[0] = -(x * m00 + y * m10);
  g[1] = -(x * m01 + y * m11);
  g[2] = -(y * m01 + z * m11);
  if (compensate) {
    const vfloat ratio = (e.a0 * e.c0 - b * b) * inverse;
    const vint free = ratio > kMinCompensation * kMinCompensation;
    const vfloat v_ratio = select(free, 0.5f * v_compensation / sqrt(select(free, ratio, splat(1.0f))), vfloat{}) * inverse;
    g[0] += v_ratio * (e.c0 - ratio * c);
    g[1] += v_ratio * b * (ratio - 1);
    g[2] += v_ratio * (e.a0 - ratio * a);
  }
}

template <CameraModel model>
static void backward_model(const ProjectionInput& in, const ProjectionOutputGradient& from, const ProjectionInputGradient& to,
                           int64_t begin, int64_t end) {
  const View<model> view(in);
  vfloat v_view[12] = {};
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    vfloat radii[2];
    load_rows<2>(reinterpret_cast<const float*>(from.radii), first, count, radii);
    const vint valid = ((vint)radii[0] > 0) & (ramp() < float(count));
    vfloat v_mean[3] = {}, v_q[4] = {}, v_s[3] = {};
    Symmetric3 v_sigma = {};
    if (bits(valid) != 0) {
      vfloat mean[3];
      load_rows<3>(in.means, first, count, mean);
      const Point3 p = view.to_camera(mean);
      const Geometry geometry = load_geometry(in, first, count);
      const ImagePoint image = Projector<model>::forward(view.k, p);
      const Ellipse e = ellipse_of(view, image, geometry.sigma);

      vfloat v_means2d[2] = {}, v_depth = {}, v_conic[3] = {}, v_compensation = {}, g[3];
      if (from.means2d != nullptr) load_rows<2>(from.means2d, first, count, v_means2d);
      if (from.depths != nullptr) load_rows<1>(from.depths, first, count, &v_depth);
      if (from.conics != nullptr) load_rows<3>(from.conics, first, count, v_conic);
      if (from.compensations != nullptr) load_rows<1>(from.compensations, first, count, &v_compensation);
      covariance2d_gradient(e, in.eps2d, v_conic, from.compensations != nullptr, v_compensation, g);

      // Sigma' = A Sigma A^T: v_Sigma = A^T G A, v_A = 2 G A Sigma
      const vfloat G[2][2] = {{g[0], g[1]}, {g[1], g[2]}};
      vfloat ga[2][3], v_affine[2][3];
      for (int r = 0; r < 2; ++r)
        for (int c = 0; c < 3; ++c) {
          ga[r][c] = G[r][0] * e.affine[0][c] + G[r][1] * e.affine[1][c];
          v_affine[r][c] = 2 * (G[r][0] * e.half[0][c] + G[r][1] * e.half[1][c]);
        }
      int n = 0;
      for (int i = 0; i < 3; ++i)
        for (int j = i; j < 3; ++j) v_sigma.v[n++] = e.affine[0][i] * ga[0][j] + e.affine[1][i] * ga[1][j];

      vfloat v_j[2][3];
      for (int r = 0; r < 2; ++r)
        for (int c = 0; c < 3; ++c)
          v_j[r][c] = v_affine[r][0] * view.w.m[c][0] + v_affine[r][1] * view.w.m[c][1] + v_affine[r][2] * view.w.m[c][2];
      const Point3 v_point = Projector<model>::backward(view.k, p, v_means2d[0], v_means2d[1], v_j);
      const vfloat v_p[3] = {v_point.x, v_point.y, v_point.z + v_depth};
      for (int i = 0; i < 3; ++i) v_mean[i] = view.w.m[0][i] * v_p[0] + view.w.m[1][i] * v_p[1] + view.w.m[2][i] * v_p[2];
      if (to.viewmat != nullptr)
        for (int i = 0; i < 3; ++i) {
          for (int j = 0; j < 3; ++j)
            v_view[3 * i + j] +=
                select(valid, image.j[0][i] * v_affine[0][j] + image.j[1][i] * v_affine[1][j] + v_p[i] * mean[j], vfloat{});
          v_view[9 + i] += select(valid, v_p[i], vfloat{});
        }
      if (in.covars != nullptr) {
        v_sigma.v[1] *= 2;  // each off the diagonal stands for two elements of the matrix
        v_sigma.v[2] *= 2;
        v_sigma.v[4] *= 2;
      } else {
        Matrix3 v_rotation = {};
        outer_square_backward(geometry.rotation, geometry.scales, v_sigma, v_rotation, v_s);
        rotation_backward(geometry.quat, v_rotation, v_q);
      }
    }
    write_gradient<3>(to.means, first, count, valid, v_mean, to.accumulate);
    if (in.covars != nullptr) {
      write_gradient<6>(to.covars, first, count, valid, v_sigma.v, to.accumulate);
    } else {
      write_gradient<4>(to.quats, first, count, valid, v_q, to.accumulate);
      write_gradient<3>(to.scales, first, count, valid, v_s, to.accumulate);
    }
  }
  if (to.viewmat != nullptr)
    for (int i = 0; i < 12; ++i) to.viewmat[i] = sum(v_view[i]);
}

static void forward(const ProjectionInput& in, const ProjectionOutput& out, int64_t begin, int64_t end) {
  switch (in.model) {
    case kOrtho: return forward_model<kOrtho>(in, out, begin, end);
    case kFisheye: return forward_model<kFisheye>(in, out, begin, end);
    default: return forward_model<kPinhole>(in, out, begin, end);
  }
}

static void backward(const ProjectionInput& in, const ProjectionOutputGradient& from, const ProjectionInputGradient& to,
                     int64_t begin, int64_t end) {
  switch (in.model) {
    case kOrtho: return backward_model<kOrtho>(in, from, to, begin, end);
    case kFisheye: return backward_model<kFisheye>(in, from, to, begin, end);
    default: return backward_model<kPinhole>(in, from, to, begin, end);
  }
}

extern const ProjectionKernels projection_kernels = {forward, backward};

}  // namespace GSPLAT_ISA
