// One block per tile and one thread per pixel. Histograms are summed in fixed point, gradients in a fixed order.
#include "../compositing/gather_rows.cuh"
#include "cuda_check.h"
#include "cuda_scratch.h"
#include "range_histogram.h"
#include "range_histogram_math.h"

namespace gsplat::range_histogram {
namespace {

constexpr int kSide = 16;  // pixels of a tile
constexpr int kPixels = kSide * kSide;
constexpr int kWarps = kPixels / 32;
constexpr unsigned kAllLanes = 0xffffffffu;

// Id of a list entry, or -1 for an unused or invalid one.
__device__ __forceinline__ int64_t id_of(const Inputs& in, int64_t position) {
  const int32_t id = in.splats.splats.flatten_ids[position];
  return id >= 0 && id < in.splats.splats.count ? id : -1;
}

__global__ void __launch_bounds__(kPixels) add_to_bins(Inputs in, unsigned long long* bins) {
  const Tile tile = tile_of(in, blockIdx.x);
  const int x = tile.x + int(threadIdx.x) % kSide, y = tile.y + int(threadIdx.x) / kSide;
  if (x >= tile.right || y >= tile.bottom) return;
  const float factor = factor_at(in, x, y);
  if (!(factor > 0)) return;
  unsigned long long* const column = bins + int64_t(x) * in.bins;
  float through = 1;
  for (int64_t position = tile.begin; position < tile.end; ++position) {
    const int64_t id = id_of(in, position);
    if (id < 0) continue;
    const Hit hit = hit_of(in, id, float(x) + 0.5f, float(y) + 0.5f);
    if (hit.alpha == 0) continue;
    const float next = through - hit.alpha * through;
    if (!(next > kMinTransmittance)) return;
    const float weight = hit.alpha * through;
    const Depth d = depth_of(in, id, hit, factor);
    through = next;
    if (d.first >= d.end) continue;
    const float inverse = 1 / d.spread;
    float below = normal_at((float(d.first) - d.at) * inverse).cdf;
    for (int b = d.first; b < d.end; ++b) {
      const float above = normal_at((float(b + 1) - d.at) * inverse).cdf;
      const double units = rint(double(weight * (above - below)) / kQuantum);
      if (units > 0) atomicAdd(column + b, static_cast<unsigned long long>(units));
      below = above;
    }
  }
}

__global__ void __launch_bounds__(kThreads) to_floats(const unsigned long long* bins, int64_t count, float* out) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < count) out[i] = float(double(bins[i]) * kQuantum);
}

__global__ void __launch_bounds__(kPixels) tile_backward(Inputs in, const float* __restrict__ gradient, float* rows) {
  __shared__ float parts[kWarps][kGradients];
  const Tile tile = tile_of(in, blockIdx.x);
  const int x = tile.x + int(threadIdx.x) % kSide, y = tile.y + int(threadIdx.x) / kSide;
  const int warp = int(threadIdx.x) / 32, lane = int(threadIdx.x) % 32;
  const bool inside = x < tile.right && y < tile.bottom;
  const float factor = inside ? factor_at(in, x, y) : 0.0f;
  const float* const v = gradient + int64_t(inside ? x : 0) * in.bins;
  const bool open_at_start = inside && factor > 0;
  float total = 0, through = 1;
  if (open_at_start) {
    for (int64_t position = tile.begin; position < tile.end; ++position) {
      const int64_t id = id_of(in, position);
      if (id < 0) continue;
      const Hit hit = hit_of(in, id, float(x) + 0.5f, float(y) + 0.5f);
      if (hit.alpha == 0) continue;
      const float next = through - hit.alpha * through;
      if (!(next > kMinTransmittance)) break;
      total += hit.alpha * through * bin_gradients(depth_of(in, id, hit, factor), v).value;
      through = next;
    }
  }
  bool open = open_at_start;
  float before = 0;
  through = 1;
  int64_t position = tile.begin;
  for (; position < tile.end; ++position) {
    // The id is the same for all threads of the block, and so are all branches around barriers.
    const int64_t id = id_of(in, position);
    float own[kGradients] = {};
    bool hits = false;
    if (open && id >= 0) {
      const Hit hit = hit_of(in, id, float(x) + 0.5f, float(y) + 0.5f);
      if (hit.alpha > 0) {
        const float next = through - hit.alpha * through;
        open = next > kMinTransmittance;
        if (open) {
          hits = true;
          const float weight = hit.alpha * through;
          const Depth d = depth_of(in, id, hit, factor);
          const BinGradients bins = bin_gradients(d, v);
          before += weight * bins.value;
          const float v_alpha = through * bins.value - (total - before) / (1 - hit.alpha);
          splat_gradients(in, id, hit, d, weight, bins, v_alpha, own);
          through = next;
        }
      }
    }
    const bool warp_hits = __any_sync(kAllLanes, hits);
#pragma unroll
    for (int k = 0; k < kGradients; ++k) {
      float value = own[k];
      if (warp_hits)
        for (int mask = 16; mask > 0; mask /= 2) value += __shfl_xor_sync(kAllLanes, value, mask);
      if (lane == 0) parts[warp][k] = value;
    }
    const int any_open = __syncthreads_or(open || hits);
    if (threadIdx.x < kGradients) {
      float sum = 0;
      for (int w = 0; w < kWarps; ++w) sum += parts[w][threadIdx.x];
      rows[position * kGradients + threadIdx.x] = sum;
    }
    __syncthreads();
    if (!any_open) {
      ++position;
      break;
    }
  }
  for (int64_t i = position * kGradients + threadIdx.x; i < tile.end * kGradients; i += kPixels) rows[i] = 0;
}

// Sum the rows of each splat in list order. One thread per splat and column.
__global__ void __launch_bounds__(kThreads)
    gather(Inputs in, const uint32_t* positions, const uint2* ranges, const float* rows, InputGradients out) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x, splat = i / kGradients;
  if (splat >= in.splats.splats.count) return;
  const int column = int(i % kGradients);
  double sum = 0;
  const uint2 range = ranges[splat];
  for (uint32_t k = range.x; k < range.y; ++k) sum += double(rows[int64_t(positions[k]) * kGradients + column]);
  const float value = float(sum);
  if (column < 2)
    out.means2d[2 * splat + column] = value;
  else if (column < 5)
    out.conics[3 * splat + column - 2] = value;
  else if (column == 5)
    out.opacities[splat] = value;
  else
    out.rays[kRayNumbers * splat + column - 6] = value;
}

}  // namespace

void histogram_on_device(const Inputs& in, float* out, CudaScratch& scratch, cudaStream_t stream) {
  const int64_t values = int64_t(in.splats.splats.width) * in.bins, tiles = in.splats.splats.tiles();
  if (values == 0) return;
  unsigned long long* const bins = scratch.array<unsigned long long>(values);
  check_cuda(cudaMemsetAsync(bins, 0, size_t(values) * sizeof(unsigned long long), stream), "clearing histograms");
  if (tiles > 0) add_to_bins<<<unsigned(tiles), kPixels, 0, stream>>>(in, bins);
  to_floats<<<blocks_for(values), kThreads, 0, stream>>>(bins, values, out);
}

void histogram_backward_on_device(const Inputs& in, const float* gradient, const InputGradients& out, CudaScratch& scratch,
                                  cudaStream_t stream) {
  const compositing::Inputs& splats = in.splats.splats;
  if (splats.count == 0) return;
  float* const rows = scratch.array<float>(splats.instances * kGradients);
  if (splats.tiles() > 0) tile_backward<<<unsigned(splats.tiles()), kPixels, 0, stream>>>(in, gradient, rows);
  const compositing::Instances instances = compositing::by_splat(splats, scratch, stream);
  gather<<<blocks_for(splats.count * kGradients), kThreads, 0, stream>>>(in, instances.positions, instances.ranges, rows, out);
}

}  // namespace gsplat::range_histogram
