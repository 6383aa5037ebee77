// Basis functions and their gradients, one direction per lane; shared by the CPU and CUDA kernels.
#pragma once

#include "simd.h"

namespace GSPLAT_ISA::spherical_harmonics {

// Compute the basis functions at unit directions, in the order and with the signs used by 3DGS.
template <int degree>
GSPLAT_INLINE void bases_at(vfloat x, vfloat y, vfloat z, vfloat* b) {
  b[0] = splat(0.28209479177387814f);
  if constexpr (degree >= 1) {
    b[1] = -0.4886025119029199f * y;
    b[2] = 0.4886025119029199f * z;
    b[3] = -0.4886025119029199f * x;
  }
  if constexpr (degree >= 2) {
    const vfloat zz = z * z, c2 = x * x - y * y, s2 = 2 * x * y;
    b[4] = 0.5462742152960395f * s2;
    b[5] = -1.0925484305920792f * y * z;
    b[6] = 0.9461746957575601f * zz - 0.31539156525252005f;
    b[7] = -1.0925484305920792f * x * z;
    b[8] = 0.5462742152960395f * c2;
    if constexpr (degree >= 3) {
      const vfloat c3 = x * c2 - y * s2, s3 = x * s2 + y * c2;
      const vfloat lift = 0.4570457994644658f - 2.285228997322329f * zz;
      b[9] = -0.5900435899266435f * s3;
      b[10] = 1.445305721320277f * z * s2;
      b[11] = lift * y;
      b[12] = z * (1.865881662950577f * zz - 1.1195289977703462f);
      b[13] = lift * x;
      b[14] = 1.445305721320277f * z * c2;
      b[15] = -0.5900435899266435f * c3;
      if constexpr (degree >= 4) {
        const vfloat c4 = x * c3 - y * s3, s4 = x * s3 + y * c3;
        const vfloat tilt = z * (2.0071396306718676f - 4.683325804901025f * zz);
        const vfloat ring = 3.31161143515146f * zz - 0.47308734787878f;
        b[16] = 0.6258357354491761f * s4;
        b[17] = -1.7701307697799304f * z * s3;
        b[18] = ring * s2;
        b[19] = tilt * y;
        b[20] = 0.10578554691520431f * ((35 * zz - 30) * zz + 3);
        b[21] = tilt * x;
        b[22] = ring * c2;
        b[23] = -1.7701307697799304f * z * c3;
        b[24] = 0.6258357354491761f * c4;
      }
    }
  }
}

// Gradient with respect to the unit direction, given those of the basis functions.
// d(c_n, s_n)/dx = n (c_{n-1}, s_{n-1}) and d(c_n, s_n)/dy = n (-s_{n-1}, c_{n-1}).
template <int degree>
GSPLAT_INLINE void bases_backward(vfloat x, vfloat y, vfloat z, const vfloat* v, vfloat* v_x, vfloat* v_y, vfloat* v_z) {
  *v_x = *v_y = *v_z = vfloat{};
  if constexpr (degree >= 1) {
    *v_x = -0.4886025119029199f * v[3];
    *v_y = -0.4886025119029199f * v[1];
    *v_z = 0.4886025119029199f * v[2];
  }
  if constexpr (degree >= 2) {
    const vfloat zz = z * z, c2 = x * x - y * y, s2 = 2 * x * y;
    vfloat v_c2 = 0.5462742152960395f * v[8], v_s2 = 0.5462742152960395f * v[4], v_zz = 0.9461746957575601f * v[6];
    *v_x -= 1.0925484305920792f * z * v[7];
    *v_y -= 1.0925484305920792f * z * v[5];
    *v_z -= 1.0925484305920792f * (y * v[5] + x * v[7]);
    if constexpr (degree >= 3) {
      const vfloat c3 = x * c2 - y * s2, s3 = x * s2 + y * c2;
      const vfloat lift = 0.4570457994644658f - 2.285228997322329f * zz;
      vfloat v_c3 = -0.5900435899266435f * v[15], v_s3 = -0.5900435899266435f * v[9];
      v_s2 += 1.445305721320277f * z * v[10];
      v_c2 += 1.445305721320277f * z * v[14];
      *v_x += lift * v[13];
      *v_y += lift * v[11];
      *v_z += 1.445305721320277f * (s2 * v[10] + c2 * v[14]) + (3 * 1.865881662950577f * zz - 1.1195289977703462f) * v[12];
      v_zz -= 2.285228997322329f * (y * v[11] + x * v[13]);
      if constexpr (degree >= 4) {
        const vfloat v_c4 = 0.6258357354491761f * v[24], v_s4 = 0.6258357354491761f * v[16];
        const vfloat tilt = z * (2.0071396306718676f - 4.683325804901025f * zz);
        const vfloat ring = 3.31161143515146f * zz - 0.47308734787878f;
        v_s3 -= 1.7701307697799304f * z * v[17];
        v_c3 -= 1.7701307697799304f * z * v[23];
        v_s2 += ring * v[18];
        v_c2 += ring * v[22];
        *v_x += tilt * v[21] + 4 * (c3 * v_c4 + s3 * v_s4);
        *v_y += tilt * v[19] + 4 * (c3 * v_s4 - s3 * v_c4);
        *v_z += -1.7701307697799304f * (s3 * v[17] + c3 * v[23]) +
                (2.0071396306718676f - 3 * 4.683325804901025f * zz) * (y * v[19] + x * v[21]);
        v_zz += 3.31161143515146f * (s2 * v[18] + c2 * v[22]) + 0.10578554691520431f * (70 * zz - 30) * v[20];
      }
      *v_x += 3 * (c2 * v_c3 + s2 * v_s3);
      *v_y += 3 * (c2 * v_s3 - s2 * v_c3);
    }
    *v_x += 2 * (x * v_c2 + y * v_s2);
    *v_y += 2 * (x * v_s2 - y * v_c2);
    *v_z += 2 * z * v_zz;
  }
}

}  // namespace GSPLAT_ISA::spherical_harmonics
