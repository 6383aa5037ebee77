#include "covariance.h"
#include "covariance_math.h"
#include "simd.h"
#include "transposed_rows.h"

namespace GSPLAT_ISA::covariance {

static void forward(const float* quats, const float* scales, float* out, bool inverse, bool triu, int64_t begin, int64_t end) {
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    vfloat q[4], s[3];
    load_rows<4>(quats, first, count, q);
    load_rows<3>(scales, first, count, s);
    if (inverse)
      for (int k = 0; k < 3; ++k) s[k] = 1.0f / s[k];
    const Symmetric3 c = outer_square(rotation_of(normalise(q)), s);
    if (triu) {
      store_rows<6>(out, first, count, c.v);
    } else {
      const vfloat full[9] = {c.v[0], c.v[1], c.v[2], c.v[1], c.v[3], c.v[4], c.v[2], c.v[4], c.v[5]};
      store_rows<9>(out, first, count, full);
    }
  }
}

// Return the gradient as a symmetric matrix: each of two equal off-diagonal elements receives half of their sum.
GSPLAT_INLINE Symmetric3 load_gradient(const float* v, bool triu, int64_t first, int count) {
  Symmetric3 g;
  if (triu) {
    load_rows<6>(v, first, count, g.v);
    g.v[1] *= 0.5f;
    g.v[2] *= 0.5f;
    g.v[4] *= 0.5f;
  } else {
    vfloat m[9];
    load_rows<9>(v, first, count, m);
    g = {{m[0], 0.5f * (m[1] + m[3]), 0.5f * (m[2] + m[6]), m[4], 0.5f * (m[5] + m[7]), m[8]}};
  }
  return g;
}

static void backward(const float* quats, const float* scales, const float* v_covars, const float* v_precis, bool triu,
                     float* v_quats, float* v_scales, int64_t begin, int64_t end) {
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    vfloat q[4], s[3], v_q[4], v_s[3] = {};
    load_rows<4>(quats, first, count, q);
    load_rows<3>(scales, first, count, s);
    const UnitQuat quat = normalise(q);
    const Matrix3 rotation = rotation_of(quat);
    Matrix3 v_rotation = {};
    if (v_covars != nullptr) outer_square_backward(rotation, s, load_gradient(v_covars, triu, first, count), v_rotation, v_s);
    if (v_precis != nullptr) {
      vfloat inverse[3], v_inverse[3];
      for (int k = 0; k < 3; ++k) inverse[k] = 1.0f / s[k];
      outer_square_backward(rotation, inverse, load_gradient(v_precis, triu, first, count), v_rotation, v_inverse);
      for (int k = 0; k < 3; ++k) v_s[k] -= v_inverse[k] * inverse[k] * inverse[k];
    }
    rotation_backward(quat, v_rotation, v_q);
    store_rows<4>(v_quats, first, count, v_q);
    store_rows<3>(v_scales, first, count, v_s);
  }
}

extern const gsplat::covariance::Kernels kernels = {forward, backward};

}  // namespace GSPLAT_ISA::covariance
