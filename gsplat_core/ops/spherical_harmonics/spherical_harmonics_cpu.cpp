#include "simd.h"
#include "spherical_harmonics.h"
#include "spherical_harmonics_bases.h"
#include "transposed_rows.h"

namespace GSPLAT_ISA::spherical_harmonics {

using namespace gsplat::spherical_harmonics;

typedef float vfloat4 __attribute__((vector_size(16)));

template <int degree>
GSPLAT_INLINE void unit_bases(const float* dirs, int64_t first, int count, vfloat* unit, vfloat* inverse_norm,
                              float (*b)[kLanes]) {
  vfloat d[3], columns[kMaxBases];
  load_rows<3>(dirs, first, count, d);
  *inverse_norm = 1.0f / sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
  for (int i = 0; i < 3; ++i) unit[i] = d[i] * *inverse_norm;
  bases_at<degree>(unit[0], unit[1], unit[2], columns);
  for (int k = 0; k < (degree + 1) * (degree + 1); ++k) store(b[k], columns[k]);
}

GSPLAT_INLINE vfloat4 load4(const float* p) {
  vfloat4 v;
  __builtin_memcpy(&v, p, sizeof(v));
  return v;
}

template <int degree>
static void forward_degree(const SphericalHarmonicsInput& in, float* colors, int64_t begin, int64_t end) {
  constexpr int used = (degree + 1) * (degree + 1);
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    float b[used][kLanes];
    vfloat unit[3], inverse_norm;
    unit_bases<degree>(in.dirs, first, count, unit, &inverse_norm, b);
    for (int lane = 0; lane < count; ++lane) {
      float* color = colors + 3 * (first + lane);
      if (in.mask != nullptr && !in.mask[first + lane]) {
        color[0] = color[1] = color[2] = 0;
        continue;
      }
      // Load red, green, blue and one unused float at once. The last coefficient is loaded one float earlier, to stay
      // in bounds.
      const float* c = in.coeffs + (first + lane) * in.bases * 3;
      vfloat4 even = {}, odd = {};
      for (int k = 0; k + 1 < used; ++k) (k & 1 ? odd : even) += b[k][lane] * load4(c + 3 * k);
      const vfloat4 total = even + odd;
      const float last = b[used - 1][lane];
      for (int i = 0; i < 3; ++i) color[i] = total[i] + last * c[3 * (used - 1) + i];
    }
  }
}

template <int degree>
static void backward_degree(const SphericalHarmonicsInput& in, const float* v_colors, float* v_dirs, float* v_coeffs,
                            bool accumulate, int64_t begin, int64_t end) {
  constexpr int used = (degree + 1) * (degree + 1);
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    float b[used][kLanes], v_b[used][kLanes] = {};
    vfloat unit[3], inverse_norm;
    unit_bases<degree>(in.dirs, first, count, unit, &inverse_norm, b);
    for (int lane = 0; lane < count; ++lane) {
      const int64_t row = first + lane;
      const float* c = in.coeffs + row * in.bases * 3;
      float* out = v_coeffs + row * in.bases * 3;
      const float* v = v_colors + 3 * row;
      const bool seen = in.mask == nullptr || in.mask[row];
      if (!seen) {
        if (!accumulate) __builtin_memset(out, 0, size_t(in.bases) * 3 * sizeof(float));
        continue;
      }
      if (accumulate) {
        for (int k = 0; k < used; ++k)
          for (int i = 0; i < 3; ++i) out[3 * k + i] += b[k][lane] * v[i];
      } else {
        // Store four floats at a time; the next store overwrites the fourth. The last row is stored separately.
        const vfloat4 v4 = {v[0], v[1], v[2], 0};
        for (int k = 0; k + 1 < used; ++k) {
          const vfloat4 g = b[k][lane] * v4;
          __builtin_memcpy(out + 3 * k, &g, sizeof(g));
        }
        for (int i = 0; i < 3; ++i) out[3 * (used - 1) + i] = b[used - 1][lane] * v[i];
        __builtin_memset(out + 3 * used, 0, size_t(in.bases - used) * 3 * sizeof(float));
      }
      if (v_dirs != nullptr)
        for (int k = 1; k < used; ++k) v_b[k][lane] = v[0] * c[3 * k] + v[1] * c[3 * k + 1] + v[2] * c[3 * k + 2];
    }
    if (v_dirs == nullptr) continue;
    vfloat columns[used], g[3];
    for (int k = 0; k < used; ++k) columns[k] = load(v_b[k]);
    bases_backward<degree>(unit[0], unit[1], unit[2], columns, g, g + 1, g + 2);
    const vfloat along = g[0] * unit[0] + g[1] * unit[1] + g[2] * unit[2];
    for (int i = 0; i < 3; ++i) g[i] = (g[i] - along * unit[i]) * inverse_norm;
    if (in.mask != nullptr) {
      // The gradient of a masked direction is 0. Its computed gradient may be NaN, because the direction may hold any
      // value.
      vfloat seen;
      for (int lane = 0; lane < kLanes; ++lane) seen[lane] = lane < count && in.mask[first + lane];
      for (int i = 0; i < 3; ++i) g[i] = select(seen > 0, g[i], vfloat{});
    }
    if constexpr (degree == 0) g[0] = g[1] = g[2] = vfloat{};  // degree 0 does not depend on the direction, which may be zero
    store_rows<3>(v_dirs, first, count, g);
  }
}

static void forward(const SphericalHarmonicsInput& in, float* colors, int64_t begin, int64_t end) {
  switch (in.degree) {
    case 0: return forward_degree<0>(in, colors, begin, end);
    case 1: return forward_degree<1>(in, colors, begin, end);
    case 2: return forward_degree<2>(in, colors, begin, end);
    case 3: return forward_degree<3>(in, colors, begin, end);
    default: return forward_degree<4>(in, colors, begin, end);
  }
}

static void backward(const SphericalHarmonicsInput& in, const float* v_colors, float* v_dirs, float* v_coeffs, bool accumulate,
                     int64_t begin, int64_t end) {
  switch (in.degree) {
    case 0: return backward_degree<0>(in, v_colors, v_dirs, v_coeffs, accumulate, begin, end);
    case 1: return backward_degree<1>(in, v_colors, v_dirs, v_coeffs, accumulate, begin, end);
    case 2: return backward_degree<2>(in, v_colors, v_dirs, v_coeffs, accumulate, begin, end);
    case 3: return backward_degree<3>(in, v_colors, v_dirs, v_coeffs, accumulate, begin, end);
    default: return backward_degree<4>(in, v_colors, v_dirs, v_coeffs, accumulate, begin, end);
  }
}

extern const Kernels kernels = {forward, backward};

}  // namespace GSPLAT_ISA::spherical_harmonics
