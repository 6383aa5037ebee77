#include <cuda_pipeline.h>

#include "cuda_scratch.h"
#include "spherical_harmonics.h"
#include "spherical_harmonics_bases.h"

namespace gsplat::spherical_harmonics {
namespace {

using namespace GSPLAT_ISA::spherical_harmonics;

constexpr int kSets = 32;  // of a warp, one per lane
constexpr int kWarps = 4;
constexpr int kBlockSets = kWarps * kSets;

// Coefficients of a set that a degree uses. Their pitch in shared memory is odd: lanes that read the same place of their own
// sets read from different banks.
constexpr int width_of(int degree) { return 3 * (degree + 1) * (degree + 1); }
constexpr int pitch_of(int degree) { return width_of(degree) | 1; }

struct UnitDirection {
  float v[3], inverse_norm;
};

__device__ UnitDirection unit_direction(const float* dirs, int64_t i) {
  const float x = dirs[3 * i], y = dirs[3 * i + 1], z = dirs[3 * i + 2];
  const float inverse = 1.0f / ::sqrtf(x * x + y * y + z * z);
  return {{x * inverse, y * inverse, z * inverse}, inverse};
}

// A set's coefficients are 3 K consecutive floats, so a lane alone would touch as many sectors of memory as it reads
// numbers. The warp's sets together are one run: it is copied through shared memory, neighbouring lanes at neighbouring places,
// without the sets that `wanted` (a bit per lane) leaves out.
template <int degree>
__device__ void fetch_sets(float* shared, const float* coeffs, int64_t row, unsigned wanted, int lane) {
  constexpr int width = width_of(degree), pitch = pitch_of(degree);
#pragma unroll 12
  for (int at = lane; at < kSets * width; at += 32) {
    const int set = at / width, place = at % width;
    if (wanted >> set & 1) __pipeline_memcpy_async(shared + set * pitch + place, coeffs + set * row + place, sizeof(float));
  }
  __pipeline_commit();
  __pipeline_wait_prior(0);
  __syncwarp();
}

// Copies back: the used coefficients of the warp's `sets` sets, and zeros for those that the degree does not use.
template <int degree>
__device__ void put_sets(float* coeffs, const float* shared, int64_t row, int sets, int lane) {
  constexpr int width = width_of(degree), pitch = pitch_of(degree);
  __syncwarp();
#pragma unroll 12
  for (int at = lane; at < kSets * width; at += 32) {
    const int set = at / width, place = at % width;
    if (set < sets) coeffs[set * row + place] = shared[set * pitch + place];
  }
  const int unused = int(row) - width;
  for (int at = lane; at < sets * unused; at += 32) coeffs[at / unused * row + width + at % unused] = 0;
}

// A block has 128 sets and one row of directions.
template <int degree>
__global__ void __launch_bounds__(kBlockSets, 4) forward(SphericalHarmonicsInput in, int64_t sets, float* __restrict__ colors) {
  constexpr int used = (degree + 1) * (degree + 1);
  __shared__ float shared[kWarps][kSets * pitch_of(degree)];
  const int64_t blocks = (sets + kBlockSets - 1) / kBlockSets, set = blockIdx.x % blocks * kBlockSets + threadIdx.x;
  const int64_t i = blockIdx.x / blocks * sets + set;
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  const bool visible = set < sets && (in.mask == nullptr || in.mask[i]);
  const unsigned wanted = __ballot_sync(~0u, visible);
  if (wanted != 0) fetch_sets<degree>(shared[warp], in.coeffs + (set - lane) * in.bases * 3, in.bases * 3, wanted, lane);
  if (set >= sets) return;
  float color[3] = {};
  if (visible) {
    const UnitDirection d = unit_direction(in.dirs, i);
    float b[used];
    bases_at<degree>(d.v[0], d.v[1], d.v[2], b);
    const float* c = shared[warp] + lane * pitch_of(degree);
#pragma unroll
    for (int k = 0; k < used; ++k)
      for (int j = 0; j < 3; ++j) color[j] += b[k] * c[3 * k + j];
  }
  for (int j = 0; j < 3; ++j) colors[3 * i + j] = color[j];
}

// A thread has one set of coefficients and goes through its rows in order: the sum comes out the same every time. A direction
// whose colour has a gradient of zero adds nothing, not even the NaN that 0 times an infinite coefficient would be.
template <int degree>
__global__ void __launch_bounds__(kBlockSets, 4)
    backward(SphericalHarmonicsInput in, int64_t rows, int64_t sets, const float* __restrict__ v_colors,
             float* __restrict__ v_dirs, float* __restrict__ v_coeffs) {
  constexpr int used = (degree + 1) * (degree + 1);
  __shared__ float shared[kWarps][kSets * pitch_of(degree)];
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  const int64_t set = int64_t(blockIdx.x) * kBlockSets + threadIdx.x, first = set - lane;
  if (first >= sets) return;
  float* const c = shared[warp] + lane * pitch_of(degree);
  unsigned fetched = 0;
  float v_c[used][3] = {};
  for (int64_t row = 0; row < rows; ++row) {
    const int64_t i = row * sets + set;
    float v[3] = {}, g[3] = {};
    if (set < sets && (in.mask == nullptr || in.mask[i]))
      for (int j = 0; j < 3; ++j) v[j] = v_colors[3 * i + j];
    const bool shown = !(v[0] == 0 && v[1] == 0 && v[2] == 0);
    if (degree > 0 && v_dirs != nullptr) {  // a constant has no direction, not even a zero one
      const unsigned wanted = __ballot_sync(~0u, shown) & ~fetched;
      if (wanted != 0) fetch_sets<degree>(shared[warp], in.coeffs + first * in.bases * 3, in.bases * 3, wanted, lane);
      fetched |= wanted;
    }
    if (shown) {
      const UnitDirection d = unit_direction(in.dirs, i);
      float b[used], v_b[used] = {};
      bases_at<degree>(d.v[0], d.v[1], d.v[2], b);
#pragma unroll
      for (int k = 0; k < used; ++k)
        for (int j = 0; j < 3; ++j) v_c[k][j] += b[k] * v[j];
      if constexpr (degree > 0) {
        if (v_dirs != nullptr) {
#pragma unroll
          for (int k = 1; k < used; ++k) v_b[k] = v[0] * c[3 * k] + v[1] * c[3 * k + 1] + v[2] * c[3 * k + 2];
          bases_backward<degree>(d.v[0], d.v[1], d.v[2], v_b, g, g + 1, g + 2);
          const float along = g[0] * d.v[0] + g[1] * d.v[1] + g[2] * d.v[2];
          for (int j = 0; j < 3; ++j) g[j] = (g[j] - along * d.v[j]) * d.inverse_norm;
        }
      }
    }
    if (v_dirs != nullptr && set < sets)
      for (int j = 0; j < 3; ++j) v_dirs[3 * i + j] = g[j];
  }
#pragma unroll
  for (int k = 0; k < used; ++k)
    for (int j = 0; j < 3; ++j) c[3 * k + j] = v_c[k][j];
  put_sets<degree>(v_coeffs + first * in.bases * 3, shared[warp], in.bases * 3, int(min(int64_t(kSets), sets - first)), lane);
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
