#include "adam.h"
#include "cuda_scratch.h"

namespace gsplat::adam {
namespace {

constexpr int kMostRows = 1024;            // per block
constexpr int64_t kChunk = 4 * kThreads;   // values per block, unless a row is longer
constexpr int64_t kFew = 1024 * kThreads;  // up to this size one value per thread, for more memory requests in flight

// Return the factors of a step that were computed on the host.
__device__ __forceinline__ AdamStep step_of(const AdamStep& step) { return step; }

// Compute the factors of a step from device memory. One thread per block computes the powers in double; -expm1 keeps 1
// - beta^t accurate for beta near 1 and small t. Ends with a barrier.
__device__ __forceinline__ AdamStep step_of(const AdamAt& at) {
  __shared__ float rate, inv_bias2;
  if (threadIdx.x == 0) {
    const double t = double(*at.step);
    rate = float(double(*at.rate) / -expm1(t * at.log_beta1));
    inv_bias2 = float(1.0 / sqrt(-expm1(t * at.log_beta2)));
  }
  __syncthreads();
  return {rate, inv_bias2, at.fresh1, at.fresh2, at.epsilon, at.row_size};
}

// Each block first flags its rows that are not shown or contain a non-finite squared gradient, then updates the other
// rows. It counts only those with such a gradient.
template <class Step>
__global__ void __launch_bounds__(kThreads)
    adam_rows(float* __restrict__ p, const float* __restrict__ g, float* __restrict__ m, float* __restrict__ v,
              const bool* __restrict__ shown, int64_t rows, int rows_per_block, Step source, unsigned long long* skipped) {
  const AdamStep step = step_of(source);
  __shared__ int unusable[kMostRows];
  const int64_t first = int64_t(blockIdx.x) * rows_per_block;
  const int count = int(rows - first < rows_per_block ? rows - first : rows_per_block);
  const int64_t at = first * step.row_size, size = count * step.row_size;
  for (int r = threadIdx.x; r < count; r += kThreads) unusable[r] = shown != nullptr && !shown[first + r];
  __syncthreads();
  for (int64_t i = threadIdx.x; i < size; i += kThreads) {
    int& flag = unusable[count == 1 ? 0 : int(i) / int(step.row_size)];
    if (flag) continue;  // gradients of rows that are not shown are not read
    const float x = g[at + i];
    if (!isfinite(x * x)) flag = 1;  // a benign race: all threads write 1
  }
  __syncthreads();
  for (int64_t i = threadIdx.x; i < size; i += kThreads) {
    if (unusable[count == 1 ? 0 : int(i) / int(step.row_size)]) continue;
    const int64_t k = at + i;
    const float x = g[k], m_old = m[k], v_old = v[k];
    const float m_new = m_old + step.fresh1 * (x - m_old), v_new = v_old + step.fresh2 * (x * x - v_old);
    m[k] = m_new;
    v[k] = v_new;
    p[k] -= step.rate * m_new / (sqrtf(v_new) * step.inv_bias2 + step.epsilon);
  }
  // Integer sums do not depend on the order.
  for (int r = threadIdx.x; r < count; r += kThreads)
    if (unusable[r] && (shown == nullptr || shown[first + r])) atomicAdd(skipped, 1ULL);
}

template <class Step>
void launch(float* p, const float* g, float* m, float* v, const bool* shown, int64_t rows, const Step& step, int64_t* skipped,
            cudaStream_t stream) {
  if (rows == 0) return;
  const int64_t fit = (rows * step.row_size <= kFew ? kThreads : kChunk) / step.row_size;
  const int64_t per_block = fit < 1 ? 1 : fit < kMostRows ? fit : kMostRows;
  adam_rows<<<blocks_for(rows, per_block), kThreads, 0, stream>>>(p, g, m, v, shown, rows, int(per_block), step,
                                                                  reinterpret_cast<unsigned long long*>(skipped));
}

}  // namespace

void adam_on_device(float* p, const float* g, float* m, float* v, const bool* shown, int64_t rows, const AdamStep& step,
                    int64_t* skipped, cudaStream_t stream) {
  launch(p, g, m, v, shown, rows, step, skipped, stream);
}

void adam_at_on_device(float* p, const float* g, float* m, float* v, int64_t rows, const AdamAt& at, int64_t* skipped,
                       cudaStream_t stream) {
  launch(p, g, m, v, nullptr, rows, at, skipped, stream);
}

}  // namespace gsplat::adam
