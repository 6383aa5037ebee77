// Image loss with its gradients. The first kernel counts the pixels of each mean. One pass computes L1 and inverse
// depth; two more compute the similarity if it has a weight. Sums are per block, in double, and added in block order.
#include "image_loss.h"

#include "../ssim/ssim.h"
#include "cuda_check.h"
#include "cuda_scratch.h"

namespace gsplat::image_loss {
namespace {

constexpr float kLeastAlpha = 1e-10f;  // lower bound of the divisor of a pixel's depth

enum Count { kTissue, kKnownDepth, kCounts };
enum Sum { kColour, kDepth, kSums };

__device__ inline bool is_tissue(const DeviceImageLoss& in, int64_t pixel) { return in.mask == nullptr || in.mask[pixel] != 0; }

// Return the expected depth of a pixel; 0 without depth.
__device__ inline float depth_at(const DeviceImageLoss& in, int64_t pixel) {
  if (in.target_depth == nullptr) return 0;
  if (in.alphas == nullptr) return in.depth[pixel];
  return in.image[pixel * in.stride + in.channels] / fmaxf(in.alphas[pixel], kLeastAlpha);
}

__device__ inline bool knows_depth(const DeviceImageLoss& in, int64_t pixel, float depth) {
  return in.target_depth != nullptr && depth > 0 && in.target_depth[pixel] > 0 && is_tissue(in, pixel);
}

__global__ void __launch_bounds__(kThreads) count_pixels(DeviceImageLoss in, int64_t* counts) {
  __shared__ int totals[kCounts];
  if (threadIdx.x < kCounts) totals[threadIdx.x] = 0;
  __syncthreads();
  int tissue = 0, known = 0;
  for (int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x; i < in.pixels; i += int64_t(gridDim.x) * kThreads) {
    tissue += is_tissue(in, i);
    known += knows_depth(in, i, depth_at(in, i));
  }
  tissue = __reduce_add_sync(0xffffffffu, tissue);
  known = __reduce_add_sync(0xffffffffu, known);
  // Integer sums do not depend on the order. Each warp adds one number per block, because all blocks add to the same
  // address.
  if (threadIdx.x % 32 == 0) {
    atomicAdd(totals + kTissue, tissue);
    atomicAdd(totals + kKnownDepth, known);
  }
  __syncthreads();
  if (threadIdx.x < kCounts && totals[threadIdx.x] > 0)
    atomicAdd(reinterpret_cast<unsigned long long*>(counts) + threadIdx.x, static_cast<unsigned long long>(totals[threadIdx.x]));
}

__device__ inline double warp_total(double value) {
  for (int offset = 16; offset > 0; offset /= 2) value += __shfl_xor_sync(0xffffffffu, value, offset);
  return value;
}

// Sum both values over the block; the result is valid in thread 0.
__device__ inline void block_totals(double (&sums)[kSums]) {
  constexpr int kWarps = kThreads / 32;
  __shared__ double parts[kSums][kWarps];
  for (int s = 0; s < kSums; ++s) {
    const double sum = warp_total(sums[s]);
    if (threadIdx.x % 32 == 0) parts[s][threadIdx.x / 32] = sum;
  }
  __syncthreads();
  for (int s = 0; s < kSums; ++s) {
    sums[s] = 0;
    for (int warp = 0; warp < kWarps; ++warp) sums[s] += parts[s][warp];
  }
}

// |x - y| and its derivative times `slope`. The slope at zero is 0; NaN in tissue propagates to both.
struct Difference {
  float value, slope;
};
__device__ inline Difference difference(float d, float slope) {
  return {fabsf(d), d > 0 ? slope : d < 0 ? -slope : d == d ? 0 : d};
}

// d² / (2 kSteepAsL1) and its derivative times `slope`.
__device__ inline Difference squared_difference(float d, float slope) {
  return {d * d * (0.5f / kSteepAsL1), slope * (d / kSteepAsL1)};
}

__global__ void __launch_bounds__(kThreads) differences(DeviceImageLoss in, const int64_t* counts, double* block_sums) {
  const double values = double(counts[kTissue]) * in.channels, known = double(counts[kKnownDepth]);
  const float slope = values > 0 ? float((1 - double(in.ssim_weight)) / values) : 0;
  const float depth_slope = known > 0 ? float(double(in.depth_weight) / known) : 0;
  double sums[kSums] = {};
  for (int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x; i < in.pixels; i += int64_t(gridDim.x) * kThreads) {
    const bool tissue = is_tissue(in, i);
    for (int c = 0; c < in.channels; ++c) {
      Difference d = {};
      if (tissue) {
        const int64_t value = i * in.channels + c;
        const float y = in.target_bytes != nullptr ? float(in.target_bytes[value]) / 255.0f : in.target[value];
        const float off = in.image[i * in.stride + c] - y;
        d = in.squared ? squared_difference(off, slope) : difference(off, slope);
      }
      in.v_image[i * in.stride + c] = d.slope;
      sums[kColour] += double(d.value);
    }
    float v_depth = 0;
    const float depth = depth_at(in, i);
    if (knows_depth(in, i, depth)) {
      const float inverse = 1.0f / depth;
      const Difference d = difference(inverse - 1.0f / in.target_depth[i], -depth_slope * inverse * inverse);
      v_depth = d.slope;
      sums[kDepth] += double(d.value);
    }
    if (in.v_depth != nullptr) in.v_depth[i] = v_depth;
    if (in.alphas != nullptr) {
      const float v = v_depth / fmaxf(in.alphas[i], kLeastAlpha);
      in.v_image[i * in.stride + in.channels] = v;
      in.v_alphas[i] = -depth * v;
    }
  }
  block_totals(sums);
  if (threadIdx.x < kSums) block_sums[int64_t(blockIdx.x) * kSums + threadIdx.x] = sums[threadIdx.x];
}

// Compute the means of colour, SSIM and depth terms and their weighted sum, with one block; a mean of no pixels is 0.
__global__ void __launch_bounds__(kThreads) finish(DeviceImageLoss in, const int64_t* counts, const double* block_sums,
                                                   int64_t blocks, const double* ssim_sums, int64_t ssim_blocks) {
  double sums[kSums] = {};
  for (int64_t i = threadIdx.x; i < blocks; i += kThreads)
    for (int s = 0; s < kSums; ++s) sums[s] += block_sums[i * kSums + s];
  block_totals(sums);
  double ssim[kSums] = {};
  for (int64_t i = threadIdx.x; i < ssim_blocks; i += kThreads) ssim[0] += ssim_sums[i];
  __syncthreads();
  block_totals(ssim);
  if (threadIdx.x != 0) return;
  const double values = double(counts[kTissue]) * in.channels, known = double(counts[kKnownDepth]);
  const double colour = values > 0 ? sums[kColour] / values : 0, depth = known > 0 ? sums[kDepth] / known : 0;
  const double dissimilar = values > 0 ? ssim[0] / values : 0;
  in.terms[0] = float(colour), in.terms[1] = float(dissimilar), in.terms[2] = float(depth);
  *in.loss = float((1 - double(in.ssim_weight)) * colour + double(in.ssim_weight) * dissimilar + double(in.depth_weight) * depth);
}

}  // namespace

void image_loss_on_device(const DeviceImageLoss& in, CudaScratch& scratch, cudaStream_t stream) {
  constexpr int64_t kMostBlocks = 1024;  // with a few pixels per thread; limits the number of partial sums
  const int64_t wanted = blocks_for(in.pixels), blocks = wanted < 1 ? 1 : wanted < kMostBlocks ? wanted : kMostBlocks;
  int64_t* const counts = scratch.array<int64_t>(kCounts);
  double* const block_sums = scratch.array<double>(blocks * kSums);
  check_cuda(cudaMemsetAsync(counts, 0, kCounts * sizeof(int64_t), stream), "clearing the loss's counters");
  count_pixels<<<unsigned(blocks), kThreads, 0, stream>>>(in, counts);
  differences<<<unsigned(blocks), kThreads, 0, stream>>>(in, counts, block_sums);
  ssim::DeviceSsim similarity = {};
  if (in.ssim_weight != 0) {
    similarity.image = in.image, similarity.target = in.target, similarity.target_bytes = in.target_bytes,
    similarity.mask = in.mask;
    similarity.tissue = counts + kTissue, similarity.scale = -in.ssim_weight;
    similarity.height = in.height, similarity.width = in.width, similarity.channels = in.channels, similarity.stride = in.stride;
    similarity.gradient = in.v_image, similarity.sums = scratch.array<double>(similarity.blocks());
    ssim::ssim_on_device(similarity, scratch, stream);
  }
  finish<<<1, kThreads, 0, stream>>>(in, counts, block_sums, blocks, similarity.sums,
                                     in.ssim_weight != 0 ? similarity.blocks() : 0);
}

}  // namespace gsplat::image_loss
