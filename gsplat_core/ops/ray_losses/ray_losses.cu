// Losses along rays in two launches each: terms with their sums per block, then the total and the gradients. The sums of
// blocks are added in a fixed order.
#include "cuda_check.h"
#include "cuda_scratch.h"
#include "ray_losses_math.h"

namespace gsplat::ray_losses {
namespace {

using namespace GSPLAT_ISA::ray_losses;

constexpr int64_t kMostBlocks = 512;  // every block of the second launch adds the sums of all blocks

// Sum over the block, in every thread.
__device__ inline Sums block_total(Sums own) {
  constexpr int kWarps = kThreads / 32;
  __shared__ Sums parts[kWarps];
  for (int offset = 16; offset > 0; offset /= 2) {
    own.terms += __shfl_xor_sync(0xffffffffu, own.terms, offset);
    own.divisor += __shfl_xor_sync(0xffffffffu, own.divisor, offset);
  }
  if (threadIdx.x % 32 == 0) parts[threadIdx.x / 32] = own;
  __syncthreads();
  Sums total = {0, 0};
  for (int warp = 0; warp < kWarps; ++warp) {
    total.terms += parts[warp].terms;
    total.divisor += parts[warp].divisor;
  }
  return total;
}

__device__ inline void write_total(const Sums& own, Sums* blocks) {
  const Sums total = block_total(own);
  if (threadIdx.x == 0) blocks[blockIdx.x] = total;
}

// Return the factor of the gradients in every thread. The first block writes the loss.
__device__ inline float factor_of(const Sums* blocks, double least_divisor, float* value) {
  Sums own = {0, 0};
  for (unsigned i = threadIdx.x; i < gridDim.x; i += kThreads) {
    own.terms += blocks[i].terms;
    own.divisor += blocks[i].divisor;
  }
  const Sums total = block_total(own);
  const double factor = 1 / fmax(total.divisor, least_divisor);
  if (blockIdx.x == 0 && threadIdx.x == 0) *value = float(total.terms * factor);
  return float(factor);
}

template <class Work>
__device__ inline void for_each_pixel(int64_t pixels, const Work& work) {
  for (int64_t at = int64_t(blockIdx.x) * kThreads + threadIdx.x; at < pixels; at += int64_t(gridDim.x) * kThreads) work(at);
}

__global__ void __launch_bounds__(kThreads) depth_terms(DepthLoss loss, Sums* blocks) {
  Sums own = {0, 0};
  for_each_pixel(int64_t(loss.height) * loss.width, [&](int64_t at) {
    const DepthTerm term = depth_term(loss, at);
    own.terms += double(term.off);
    own.divisor += double(term.inverse);
  });
  write_total(own, blocks);
}

__global__ void __launch_bounds__(kThreads) depth_gradients(DepthLoss loss, const Sums* blocks, float* value) {
  const float factor = factor_of(blocks, kLeastInverse, value);
  for_each_pixel(int64_t(loss.height) * loss.width, [&](int64_t at) { loss.v_depths[at] = factor * depth_term(loss, at).slope; });
}

__global__ void __launch_bounds__(kThreads) normal_terms(NormalLoss loss, Sums* blocks) {
  Sums own = {0, 0};
  for_each_pixel(int64_t(loss.height) * loss.width, [&](int64_t at) {
    own.terms += double(write_normal_term(loss, int(at % loss.width), int(at / loss.width)));
    own.divisor += loss.bits[at] & kCompared;
  });
  write_total(own, blocks);
}

__global__ void __launch_bounds__(kThreads) normal_gradients(NormalLoss loss, const Sums* blocks, float* value) {
  const float factor = factor_of(blocks, 1, value);
  for_each_pixel(int64_t(loss.height) * loss.width,
                 [&](int64_t at) { write_normal_gradient(loss, factor, int(at % loss.width), int(at / loss.width)); });
}

unsigned blocks_of(int64_t pixels) {
  const int64_t wanted = blocks_for(pixels);
  return unsigned(wanted < 1 ? 1 : wanted < kMostBlocks ? wanted : kMostBlocks);
}

}  // namespace

void depth_loss_on_device(const DepthLoss& loss, float* value, CudaScratch& scratch, cudaStream_t stream) {
  const unsigned blocks = blocks_of(int64_t(loss.height) * loss.width);
  Sums* const sums = scratch.array<Sums>(blocks);
  depth_terms<<<blocks, kThreads, 0, stream>>>(loss, sums);
  depth_gradients<<<blocks, kThreads, 0, stream>>>(loss, sums, value);
}

void normal_loss_on_device(const NormalLoss& loss, float* value, CudaScratch& scratch, cudaStream_t stream) {
  const unsigned blocks = blocks_of(int64_t(loss.height) * loss.width);
  Sums* const sums = scratch.array<Sums>(blocks);
  normal_terms<<<blocks, kThreads, 0, stream>>>(loss, sums);
  normal_gradients<<<blocks, kThreads, 0, stream>>>(loss, sums, value);
}

}  // namespace gsplat::ray_losses
