// Two passes over tiles of one channel. The first filters the four moments vertically, then horizontally, and computes
// from them the similarity and its derivatives with respect to mean, squares and product. The second filters these
// derivatives with the same symmetric filter, which gives the gradient.
#include "cuda_scratch.h"
#include "ssim.h"

namespace gsplat::ssim {
namespace {

constexpr int kRadius = 5, kTaps = 2 * kRadius + 1;
constexpr int kTile = 32;                   // pixels per side
constexpr int kHalo = kTile + 2 * kRadius;  // including the filter's radius on both sides
constexpr int kRows = kThreads / kTile;     // rows of a tile written at once
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;

// Half of a Gaussian with a sigma of 1.5 pixels, from the centre outwards; the full filter sums to 1.
__device__ constexpr float kTap[kRadius + 1] = {0.266011724862f,  0.213005537711f,   0.10936068951f,
                                                0.0360007721284f, 0.00759875813524f, 0.00102838008448f};

// Return the Gaussian-filtered value at `at`, along a column or row of a tile in shared memory.
template <int kStep>
__device__ inline float filter(const float* at) {
  float sum = kTap[0] * at[0];
#pragma unroll
  for (int k = 1; k <= kRadius; ++k) sum = fmaf(kTap[k], at[-k * kStep] + at[k * kStep], sum);
  return sum;
}

// Channel and position of this block's tile.
struct Place {
  int left, top, channel;
  __device__ Place() : left(blockIdx.x * kTile), top(blockIdx.y * kTile), channel(blockIdx.z) {}
};

struct Pair {
  float x, y;
};

// Load both images at a pixel; 0 outside of the image and where there is no tissue. The mask selects instead of
// multiplying, so that NaN outside of tissue does not spread.
__device__ inline Pair masked_pair(const DeviceSsim& in, int row, int column, int channel) {
  if (row < 0 || row >= in.height || column < 0 || column >= in.width) return {0, 0};
  const int64_t pixel = int64_t(row) * in.width + column;
  if (in.mask != nullptr && in.mask[pixel] == 0) return {0, 0};
  const int64_t value = pixel * in.channels + channel;
  return {in.image[pixel * in.stride + channel],
          in.target_bytes != nullptr ? float(in.target_bytes[value]) / 255.0f : in.target[value]};
}

__device__ inline bool is_tissue(const DeviceSsim& in, int64_t pixel) { return in.mask == nullptr || in.mask[pixel] != 0; }

__device__ inline bool is_counted(const DeviceSsim& in, int row, int column) {
  const bool inner = row >= in.border && row < in.height - in.border && column >= in.border && column < in.width - in.border;
  return inner && is_tissue(in, int64_t(row) * in.width + column);
}

// Return dL/d(similarity) of a counted pixel's channel.
__device__ inline float weight_of(const DeviceSsim& in, int64_t pixel, int channel) {
  float weight = in.scale;
  if (in.tissue != nullptr) weight = *in.tissue > 0 ? float(double(in.scale) / (double(*in.tissue) * in.channels)) : 0;
  if (in.factor != nullptr) weight *= *in.factor;
  if (in.upstream != nullptr) weight *= in.upstream[pixel * in.channels + channel];
  return weight;
}

// Return the sum over the block, in a fixed order.
__device__ inline double block_total(double value) {
  __shared__ double parts[kThreads];
  parts[threadIdx.x] = value;
  for (int half = kThreads / 2; half > 0; half /= 2) {
    __syncthreads();
    if (int(threadIdx.x) < half) parts[threadIdx.x] += parts[threadIdx.x + half];
  }
  return parts[0];
}

__global__ void __launch_bounds__(kThreads) similarity(DeviceSsim in, float* derivatives) {
  __shared__ float x[kHalo][kHalo + 1], y[kHalo][kHalo + 1];
  __shared__ float moments[4][kTile][kHalo + 1];
  const Place p;
  for (int i = threadIdx.x; i < kHalo * kHalo; i += kThreads) {
    const int row = i / kHalo, column = i % kHalo;
    const Pair pair = masked_pair(in, p.top + row - kRadius, p.left + column - kRadius, p.channel);
    x[row][column] = pair.x, y[row][column] = pair.y;
  }
  __syncthreads();
  for (int i = threadIdx.x; i < kTile * kHalo; i += kThreads) {
    const int row = i / kHalo, column = i % kHalo;
    float mean_x = 0, mean_y = 0, squares = 0, product = 0;
#pragma unroll
    for (int k = 0; k < kTaps; ++k) {
      const float a = x[row + k][column], b = y[row + k][column], tap = kTap[k < kRadius ? kRadius - k : k - kRadius];
      mean_x = fmaf(tap, a, mean_x);
      mean_y = fmaf(tap, b, mean_y);
      squares = fmaf(tap, fmaf(a, a, b * b), squares);
      product = fmaf(tap, a * b, product);
    }
    moments[0][row][column] = mean_x, moments[1][row][column] = mean_y;
    moments[2][row][column] = squares, moments[3][row][column] = product;
  }
  __syncthreads();
  const int column = p.left + int(threadIdx.x) % kTile;
  const int64_t plane = int64_t(in.height) * in.width, planes = plane * in.channels;
  double dissimilar = 0;
  for (int r = int(threadIdx.x) / kTile; r < kTile && p.top + r < in.height; r += kRows) {
    if (column >= in.width) break;
    const int c = int(threadIdx.x) % kTile + kRadius;
    const float a = filter<1>(&moments[0][r][c]), b = filter<1>(&moments[1][r][c]);
    const float squares = filter<1>(&moments[2][r][c]), product = filter<1>(&moments[3][r][c]);
    const float ab = a * b, means = a * a + b * b;
    const float a1 = 2 * ab + kC1, a2 = 2 * (product - ab) + kC2, b1 = means + kC1, b2 = squares - means + kC2;
    const float inverse = 1.0f / (b1 * b2), same = a1 * a2 * inverse;
    const int64_t pixel = int64_t(p.top + r) * in.width + column;
    const bool counted = is_counted(in, p.top + r, column);
    if (counted) dissimilar += double(1.0f - same);
    if (in.map != nullptr) in.map[pixel * in.channels + p.channel] = same;
    if (derivatives == nullptr) continue;
    const float weight = counted ? weight_of(in, pixel, p.channel) : 0, by_b1 = b2 * inverse, by_b2 = b1 * inverse;
    float* const to = derivatives + p.channel * plane + pixel;
    to[0] = weight * 2 * (b * (a2 - a1) * inverse - a * same * (by_b1 - by_b2));
    to[planes] = -weight * same * by_b2;
    to[2 * planes] = weight * 2 * a1 * inverse;
  }
  if (in.sums == nullptr) return;
  dissimilar = block_total(dissimilar);
  if (threadIdx.x == 0) in.sums[(int64_t(blockIdx.z) * gridDim.y + blockIdx.y) * gridDim.x + blockIdx.x] = dissimilar;
}

// dL/dx = G * dL/dmean + 2 x (G * dL/dsquares) + y (G * dL/dproduct), where G is the filter.
__global__ void __launch_bounds__(kThreads) gradient(DeviceSsim in, const float* derivatives) {
  __shared__ float derivative[3][kHalo][kHalo + 1], filtered[3][kTile][kHalo + 1];
  const Place p;
  const int64_t plane = int64_t(in.height) * in.width, planes = plane * in.channels;
  for (int i = threadIdx.x; i < kHalo * kHalo; i += kThreads) {
    const int row = i / kHalo, column = i % kHalo, from_row = p.top + row - kRadius, from_column = p.left + column - kRadius;
    const bool inside = from_row >= 0 && from_row < in.height && from_column >= 0 && from_column < in.width;
    const float* const from = derivatives + p.channel * plane + int64_t(from_row) * in.width + from_column;
    for (int d = 0; d < 3; ++d) derivative[d][row][column] = inside ? from[d * planes] : 0;
  }
  __syncthreads();
  for (int i = threadIdx.x; i < kTile * kHalo; i += kThreads) {
    const int row = i / kHalo, column = i % kHalo;
    for (int d = 0; d < 3; ++d) filtered[d][row][column] = filter<kHalo + 1>(&derivative[d][row + kRadius][column]);
  }
  __syncthreads();
  const int column = p.left + int(threadIdx.x) % kTile;
  if (column >= in.width) return;
  for (int r = int(threadIdx.x) / kTile; r < kTile && p.top + r < in.height; r += kRows) {
    const int64_t pixel = int64_t(p.top + r) * in.width + column;
    if (!is_tissue(in, pixel)) continue;
    const int c = int(threadIdx.x) % kTile + kRadius;
    const Pair pair = masked_pair(in, p.top + r, column, p.channel);
    in.gradient[pixel * in.stride + p.channel] +=
        filter<1>(&filtered[0][r][c]) + 2 * pair.x * filter<1>(&filtered[1][r][c]) + pair.y * filter<1>(&filtered[2][r][c]);
  }
}

__global__ void __launch_bounds__(kThreads) mean_of(const double* sums, int64_t blocks, double values, float* mean) {
  double dissimilar = 0;
  for (int64_t i = threadIdx.x; i < blocks; i += kThreads) dissimilar += sums[i];
  dissimilar = block_total(dissimilar);
  if (threadIdx.x == 0) *mean = float(1 - dissimilar / values);
}

dim3 grid_of(const DeviceSsim& in) {
  return dim3(blocks_for(in.width, kTile), blocks_for(in.height, kTile), unsigned(in.channels));
}

}  // namespace

int64_t DeviceSsim::blocks() const {
  const dim3 grid = grid_of(*this);
  return int64_t(grid.x) * grid.y * grid.z;
}

void ssim_on_device(const DeviceSsim& in, CudaScratch& scratch, cudaStream_t stream) {
  if (in.blocks() == 0) return;
  float* derivatives = nullptr;
  if (in.gradient != nullptr) derivatives = scratch.array<float>(int64_t(3) * in.channels * in.height * in.width);
  similarity<<<grid_of(in), kThreads, 0, stream>>>(in, derivatives);
  if (in.gradient != nullptr) gradient<<<grid_of(in), kThreads, 0, stream>>>(in, derivatives);
}

void ssim_mean_on_device(DeviceSsim in, double values, float* mean, CudaScratch& scratch, cudaStream_t stream) {
  in.sums = scratch.array<double>(in.blocks());
  ssim_on_device(in, scratch, stream);
  mean_of<<<1, kThreads, 0, stream>>>(in.sums, in.blocks(), values, mean);
}

}  // namespace gsplat::ssim
