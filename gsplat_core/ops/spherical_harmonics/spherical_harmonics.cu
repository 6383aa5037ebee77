#include "cuda_scratch.h"
#include "spherical_harmonics_bases.h"
#include "spherical_harmonics_cuda.h"

using namespace GSPLAT_ISA;

namespace {

struct UnitDirection {
  float v[3], inverse_norm;
};

__device__ UnitDirection unit_direction(const float* dirs, int64_t i) {
  const float x = dirs[3 * i], y = dirs[3 * i + 1], z = dirs[3 * i + 2];
  const float inverse = 1.0f / ::sqrtf(x * x + y * y + z * z);
  return {{x * inverse, y * inverse, z * inverse}, inverse};
}

template <int degree>
__global__ void __launch_bounds__(kThreads)
    forward(SphericalHarmonicsInput in, int64_t rows, int64_t sets, float* __restrict__ colors) {
  constexpr int used = (degree + 1) * (degree + 1);
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= rows * sets) return;
  float color[3] = {};
  if (in.mask == nullptr || in.mask[i]) {
    const UnitDirection d = unit_direction(in.dirs, i);
    float b[used];
    bases_at<degree>(d.v[0], d.v[1], d.v[2], b);
    const float* c = in.coeffs + (i % sets) * in.bases * 3;
#pragma unroll
    for (int k = 0; k < used; ++k)
      for (int j = 0; j < 3; ++j) color[j] += b[k] * c[3 * k + j];
  }
  for (int j = 0; j < 3; ++j) colors[3 * i + j] = color[j];
}

// A thread has one set of coefficients and goes through its rows in order: the sum comes out the same every time.
template <int degree>
__global__ void __launch_bounds__(kThreads)
    backward(SphericalHarmonicsInput in, int64_t rows, int64_t sets, const float* __restrict__ v_colors,
             float* __restrict__ v_dirs, float* __restrict__ v_coeffs) {
  constexpr int used = (degree + 1) * (degree + 1);
  const int64_t set = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (set >= sets) return;
  const float* c = in.coeffs + set * in.bases * 3;
  float v_c[used][3] = {};
  for (int64_t row = 0; row < rows; ++row) {
    const int64_t i = row * sets + set;
    float g[3] = {};
    if (in.mask == nullptr || in.mask[i]) {
      const UnitDirection d = unit_direction(in.dirs, i);
      const float v[3] = {v_colors[3 * i], v_colors[3 * i + 1], v_colors[3 * i + 2]};
      float b[used], v_b[used] = {};
      bases_at<degree>(d.v[0], d.v[1], d.v[2], b);
#pragma unroll
      for (int k = 0; k < used; ++k)
        for (int j = 0; j < 3; ++j) v_c[k][j] += b[k] * v[j];
      if constexpr (degree > 0) {  // a constant has no direction, not even a zero one
        if (v_dirs != nullptr) {
#pragma unroll
          for (int k = 1; k < used; ++k) v_b[k] = v[0] * c[3 * k] + v[1] * c[3 * k + 1] + v[2] * c[3 * k + 2];
          bases_backward<degree>(d.v[0], d.v[1], d.v[2], v_b, g, g + 1, g + 2);
          const float along = g[0] * d.v[0] + g[1] * d.v[1] + g[2] * d.v[2];
          for (int j = 0; j < 3; ++j) g[j] = (g[j] - along * d.v[j]) * d.inverse_norm;
        }
      }
    }
    if (v_dirs != nullptr)
      for (int j = 0; j < 3; ++j) v_dirs[3 * i + j] = g[j];
  }
  float* out = v_coeffs + set * in.bases * 3;
#pragma unroll
  for (int k = 0; k < used; ++k)
    for (int j = 0; j < 3; ++j) out[3 * k + j] = v_c[k][j];
  for (int64_t k = 3 * used; k < 3 * in.bases; ++k) out[k] = 0;
}

template <int degree>
void forward_degree(const SphericalHarmonicsInput& in, int64_t rows, int64_t sets, float* colors, cudaStream_t stream) {
  forward<degree><<<blocks_for(rows * sets), kThreads, 0, stream>>>(in, rows, sets, colors);
}

template <int degree>
void backward_degree(const SphericalHarmonicsInput& in, int64_t rows, int64_t sets, const float* v_colors, float* v_dirs,
                     float* v_coeffs, cudaStream_t stream) {
  backward<degree><<<blocks_for(sets), kThreads, 0, stream>>>(in, rows, sets, v_colors, v_dirs, v_coeffs);
}

}  // namespace

void harmonics_forward(const SphericalHarmonicsInput& in, int64_t rows, int64_t sets, float* colors, cudaStream_t stream) {
  if (rows * sets == 0) return;
  constexpr decltype(&forward_degree<0>) by_degree[] = {forward_degree<0>, forward_degree<1>, forward_degree<2>,
                                                        forward_degree<3>, forward_degree<4>};
  by_degree[in.degree](in, rows, sets, colors, stream);
}

void harmonics_backward(const SphericalHarmonicsInput& in, int64_t rows, int64_t sets, const float* v_colors, float* v_dirs,
                        float* v_coeffs, cudaStream_t stream) {
  if (sets == 0) return;
  constexpr decltype(&backward_degree<0>) by_degree[] = {backward_degree<0>, backward_degree<1>, backward_degree<2>,
                                                         backward_degree<3>, backward_degree<4>};
  by_degree[in.degree](in, rows, sets, v_colors, v_dirs, v_coeffs, stream);
}
