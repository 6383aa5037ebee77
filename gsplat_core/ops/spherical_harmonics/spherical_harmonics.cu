#include "cuda_scratch.h"
#include "spherical_harmonics.h"
#include "staged_harmonics.cuh"

namespace gsplat::spherical_harmonics {
namespace {

constexpr int kSets = 32;  // per warp, one per lane
constexpr int kWarps = 4;
constexpr int kBlockSets = kWarps * kSets;

struct UnitDirection {
  float v[3], inverse_norm;
};

__device__ UnitDirection unit_direction(const float* dirs, int64_t i) {
  const float x = dirs[3 * i], y = dirs[3 * i + 1], z = dirs[3 * i + 2];
  const float inverse = 1.0f / ::sqrtf(x * x + y * y + z * z);
  return {{x * inverse, y * inverse, z * inverse}, inverse};
}

// Evaluate the colours. All threads of a block of 128 sets of coefficients process the same row of directions.
template <int degree>
__global__ void __launch_bounds__(kBlockSets, 4) forward(SphericalHarmonicsInput in, int64_t sets, float* __restrict__ colors) {
  constexpr int used = kBasesOf<degree>;
  __shared__ StagedHarmonics<degree> staged[kWarps];
  const int64_t blocks = (sets + kBlockSets - 1) / kBlockSets, set = blockIdx.x % blocks * kBlockSets + threadIdx.x;
  const int64_t i = blockIdx.x / blocks * sets + set;
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  const bool visible = set < sets && (in.mask == nullptr || in.mask[i]);
  const unsigned wanted = __ballot_sync(~0u, visible);
  if (wanted != 0) {
    const float* const rows = in.coeffs + (set - lane) * in.bases * 3;
    staged[warp].load(rows, in.bases * 3, wanted, reinterpret_cast<uintptr_t>(rows) % 16 == 0);
    staged[warp].wait();
  }
  if (set >= sets) return;
  float color[3] = {};
  if (visible) {
    const UnitDirection d = unit_direction(in.dirs, i);
    float b[used];
    bases_at<degree>(d.v[0], d.v[1], d.v[2], b);
    staged[warp].add_color(b, color);
  }
  for (int j = 0; j < 3; ++j) colors[3 * i + j] = color[j];
}

// Compute the gradient of the coefficients. A thread has one set of coefficients and iterates over its rows in order,
// so the sum is reproducible. A direction whose colour gradient is zero is skipped, so that 0 times an infinite
// coefficient does not produce NaN.
template <int degree>
__global__ void __launch_bounds__(kBlockSets, 4)
    backward(SphericalHarmonicsInput in, int64_t rows, int64_t sets, const float* __restrict__ v_colors,
             float* __restrict__ v_dirs, float* __restrict__ v_coeffs) {
  constexpr int used = kBasesOf<degree>;
  __shared__ StagedHarmonics<degree> staged[kWarps];
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  const int64_t set = int64_t(blockIdx.x) * kBlockSets + threadIdx.x, first = set - lane;
  if (first >= sets) return;
  float* const c = staged[warp].row(lane);
  unsigned fetched = 0;
  float v_c[used][3] = {};
  for (int64_t row = 0; row < rows; ++row) {
    const int64_t i = row * sets + set;
    float v[3] = {}, g[3] = {};
    if (set < sets && (in.mask == nullptr || in.mask[i]))
      for (int j = 0; j < 3; ++j) v[j] = v_colors[3 * i + j];
    const bool shown = !(v[0] == 0 && v[1] == 0 && v[2] == 0);
    if (degree > 0 && v_dirs != nullptr) {  // degree 0 does not depend on the direction, which may be zero
      const unsigned wanted = __ballot_sync(~0u, shown) & ~fetched;
      if (wanted != 0) {
        const float* const rows = in.coeffs + first * in.bases * 3;
        staged[warp].load(rows, in.bases * 3, wanted, reinterpret_cast<uintptr_t>(rows) % 16 == 0);
        staged[warp].wait();
      }
      fetched |= wanted;
    }
    if (shown) {
      const UnitDirection d = unit_direction(in.dirs, i);
      float b[used];
      bases_at<degree>(d.v[0], d.v[1], d.v[2], b);
#pragma unroll
      for (int k = 0; k < used; ++k)
        for (int j = 0; j < 3; ++j) v_c[k][j] += b[k] * v[j];
      if constexpr (degree > 0) {
        if (v_dirs != nullptr) {
          direction_gradient<degree>(d.v, d.inverse_norm, c, v, g);
        }
      }
    }
    if (v_dirs != nullptr && set < sets)
      for (int j = 0; j < 3; ++j) v_dirs[3 * i + j] = g[j];
  }
#pragma unroll
  for (int k = 0; k < used; ++k)
    for (int j = 0; j < 3; ++j) c[3 * k + j] = v_c[k][j];
  __syncwarp();
  staged[warp].store(v_coeffs + first * in.bases * 3, in.bases * 3, int(min(int64_t(kSets), sets - first)));
}

template <int degree>
void forward_degree(const SphericalHarmonicsInput& in, int64_t rows, int64_t sets, float* colors, cudaStream_t stream) {
  forward<degree><<<unsigned(rows * blocks_for(sets, kBlockSets)), kBlockSets, 0, stream>>>(in, sets, colors);
}

template <int degree>
void backward_degree(const SphericalHarmonicsInput& in, int64_t rows, int64_t sets, const float* v_colors, float* v_dirs,
                     float* v_coeffs, cudaStream_t stream) {
  backward<degree><<<blocks_for(sets, kBlockSets), kBlockSets, 0, stream>>>(in, rows, sets, v_colors, v_dirs, v_coeffs);
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

}  // namespace gsplat::spherical_harmonics
