// Last step of a frame of weighted sums (Hou et al. 2024, "Sort-free Gaussian Splatting via Weighted Sum Rendering"): one
// block per tile adds the terms of the tile's splats in fixed point, in any order, and divides by the sum of weights.
#include "../blending/blend_forward.cuh"
#include "dependent_launch.cuh"
#include "frame.h"

namespace gsplat::frame {
namespace {

using namespace blending;

constexpr int kChannels = 4;  // red, green, blue, depth

// Binary places of the terms in a tile with a list of this length: kTermBits, and one less for each doubling beyond 2^17
// splats. A sum of channels is then correct as long as the mean of |term channel| over the list is below 16.
__device__ inline int term_bits(int length) { return kTermBits - max(0, 15 - __clz(length)); }

// Sums of one pixel: channels in units of 2^-(bits + kChannelBits), weights in units of 2^-bits with the tile's term_bits.
struct FixedSums {
  int64_t channels[kChannels] = {}, weights = 0;

  __device__ void add(const StagedSplat<kChannels + 1>& r, float power) {
    // No pixel is ever finished, so adding 0 is faster than a branch. |term| is at most kMostTerm.
    const float term = power >= kLog2AlphaCutoff ? exp2_fast(power) * r.colors[kChannels] : 0;
    const int quanta = __float2int_rn(term);
    weights += quanta;
    for (int d = 0; d < kChannels; ++d)  // the compiler does not always find this instruction
      asm("mad.wide.s32 %0, %1, %2, %0;" : "+l"(channels[d]) : "r"(quanta), "r"(__float_as_int(r.colors[d])));
  }
  __device__ float weight(float quantum) const { return __ll2float_rn(weights) * quantum; }
  __device__ float channel(int d, float quantum) const {
    return __ll2float_rn(channels[d]) * quantum * (1.0f / (1 << kChannelBits));
  }
};

__global__ void __launch_bounds__(kBlockThreads, 7) sum_tiles(Scene in, Weighting weighting, Lists lists, Pixels out) {
  wait_for_preceding_kernel();
  constexpr int kBatch = kForwardBatch;
  const AlphaLimit no_limit = {1.0f, 0.0f};  // of alpha; terms are not limited to 1
  using Splat = Record<kChannels + 1>;
  static_assert(sizeof(Splat) == sizeof(Record<kChannels>));
  __shared__ ForwardStage<kChannels + 1> stage;
  const int tile = int(blockIdx.x), lane = threadIdx.x & 31, warp = threadIdx.x / 32, first_part = warp / 2 * 4 + warp % 2;
  const int begin = int(min(int64_t(lists.tile_offsets[tile]), lists.capacity));
  const int end = int(min(int64_t(lists.tile_offsets[tile + 1]), lists.capacity));
  const int left = tile % in.tile_width * kTile, top = tile / in.tile_width * kTile;
  const Window w(begin, end, left, top, min(left + kTile, in.width), min(top + kTile, in.height));
  const uint4* const hits = stage.hits[2 * warp + lane / 16];
  const float middle_x = float(w.left + kQuadrant), middle_y = float(w.top + kQuadrant), x = float(w.x) + 0.5f - middle_x;
  float y[kPixelsEach];
  for (int p = 0; p < kPixelsEach; ++p) y[p] = float(w.y[p]) + 0.5f - middle_y;
  const auto fetch_ahead = [&](int ahead) {  // this thread's splat of the batch that begins `ahead` splats before the end
    if (int(threadIdx.x) >= ahead) return faint_record<kChannels + 1>();
    const uint32_t splat = uint32_t(lists.keys[end - ahead + int(threadIdx.x)]);
    if (splat >= in.count) return faint_record<kChannels + 1>();
    Splat r = static_cast<const Splat*>(lists.records)[splat];
    r.colors[kChannels] *= float(1 << term_bits(end - begin));
    return r;
  };
  if (threadIdx.x < 2) stage.splats[threadIdx.x][kBatch] = staged(faint_record<kChannels + 1>(), middle_x, middle_y, no_limit);
  FixedSums sums[kPixelsEach];
  Splat next = fetch_ahead(end - begin);
  int now = 0;
  for (int ahead = end - begin; ahead > 0; ahead -= kBatch, now ^= 1) {
    stage_splat<kQuadrant / 2>(int(threadIdx.x), 32 * warp < ahead, next, w, stage.splats[now], stage.reached[now], no_limit);
    __syncthreads();
    next = fetch_ahead(ahead - kBatch);  // prefetched
    const int count = list_hits<kChannels + 1>(&stage.reached[now][first_part], stage.splats[now], stage.hits[2 * warp]);
    for (int j = 0; j < count; j += kUnrolled) {
      const uint4 four = hits[j / 4];
      const uint32_t addresses[kUnrolled] = {four.x, four.y, four.z, four.w};
#pragma unroll
      for (const uint32_t address : addresses) {
        const StagedSplat<kChannels + 1> r = staged_at<kChannels + 1, false>(address);
        const float constant = fmaf(fmaf(r.by_xx, x, r.by_x), x, r.k), by_y = fmaf(r.by_xy, x, r.by_y);
        for (int p = 0; p < kPixelsEach; ++p) sums[p].add(r, fmaf(fmaf(r.by_yy, y[p], by_y), y[p], constant));
      }
    }
  }
  const float behind = *weighting.behind, quantum = 1.0f / float(1 << term_bits(end - begin));
  for (int p = 0; p < kPixelsEach; ++p) {
    if (!w.inside[p]) continue;
    const float weight = sums[p].weight(quantum), total = fmaxf(weight + behind, weighting.least_total), inverse = 1 / total;
    float color[3];
    for (int d = 0; d < 3; ++d) {
      const float of_splats = sums[p].channel(d, quantum);
      color[d] = (in.background != nullptr ? fmaf(behind, in.background[d], of_splats) : of_splats) * inverse;
    }
    const float z = weight > weighting.least_share ? sums[p].channel(3, quantum) / weight * *weighting.distance : 0;
    const int64_t pixel = int64_t(w.y[p]) * in.width + w.x;
    out.alphas[pixel] = 1 - fminf(behind * inverse, 1.0f);
    reinterpret_cast<float4*>(out.image)[pixel] = make_float4(color[0], color[1], color[2], z);
  }
}

}  // namespace

void sum_weighted(const Scene& in, const Weighting& weighting, const Lists& lists, const Pixels& out, cudaStream_t stream) {
  if (in.tiles() == 0) return;
  launch_dependent(sum_tiles, unsigned(in.tiles()), kBlockThreads, stream, 0, in, weighting, lists, out);
}

}  // namespace gsplat::frame
