// The gradient of a frame's blending: per tile, from the back to the front, one row of sums for every instance.
//
// The formulas are those of ops/compositing. A row is the sum over the tile's pixels in a fixed order, and every instance has its
// own: nothing is added up by arrival, so the bits are the same every time.
#include "../compositing/splat_records.cuh"
#include "frame_gradients_cuda.h"

namespace {

constexpr int kBatch = 64;    // splats that are staged at once
constexpr int kValues = 16;   // that a warp sums at once
constexpr int kChannels = 4;  // red, green, blue, z

// Sums 2 kHalf values over groups of 4 kHalf lanes with one exchange per value: a lane gives half of its values away, then half
// of the rest. For 16 values lane i of the warp returns the sum of value i / 2.
template <int kHalf>
__device__ inline float warp_sums(float* v, int lane) {
  if constexpr (kHalf == 0) {
    return v[0] + __shfl_xor_sync(kAll, v[0], 1);
  } else {
    const bool upper = (lane & 2 * kHalf) != 0;
#pragma unroll
    for (int i = 0; i < kHalf; ++i) {
      const float low = v[i], high = v[i + kHalf];
      v[i] = (upper ? high : low) + __shfl_xor_sync(kAll, upper ? low : high, 2 * kHalf);
    }
    return warp_sums<kHalf / 2>(v, lane);
  }
}

// One pixel on the way from the back to the front.
struct Pixel {
  float through;  // transmittance in front of the splats seen so far
  float behind;   // sum of w g of what is behind, g = <dL/dcolour, colour>
  int last;
  float center_y, v_color[kChannels];
};

// A tile of this block, and the quadrant of 8x8 pixels of its warp.
struct Tile {
  int begin, end;
  int quadrant_x, quadrant_y, x;

  __device__ Tile(const FrameScene& scene, const FrameLists& lists) {
    const int tile = blockIdx.x, warp = threadIdx.x / 32;
    begin = lists.tile_offsets[tile];
    end = min(int64_t(lists.tile_offsets[tile + 1]), lists.capacity);
    quadrant_x = tile % scene.tile_width * kFrameTile + warp % 2 * kQuadrant;
    quadrant_y = tile / scene.tile_width * kFrameTile + warp / 2 * kQuadrant;
    x = quadrant_x + (threadIdx.x & 31) % kQuadrant;
  }
};

__device__ inline Pixel start_pixel(const FrameScene& scene, const FrameGradients& from, int x, int y) {
  Pixel p = {1, 0, -1, float(y) + 0.5f, {}};
  if (x >= scene.width || y >= scene.height) return p;
  const int64_t at = int64_t(y) * scene.width + x;
  const float4 v = reinterpret_cast<const float4*>(from.v_image)[at];
  p.last = from.last[at];
  p.through = 1 - from.alphas[at];
  float v_left = from.v_alphas != nullptr ? -from.v_alphas[at] : 0;
  if (scene.background != nullptr) v_left += v.x * scene.background[0] + v.y * scene.background[1] + v.z * scene.background[2];
  p.behind = p.through * v_left;
  p.v_color[0] = v.x, p.v_color[1] = v.y, p.v_color[2] = v.z, p.v_color[3] = v.w;
  return p;
}

// The furthest position that any pixel of the block blended, -1 if there is none.
__device__ inline int block_furthest(int warp_furthest) {
  __shared__ int most[kWarps];
  if ((threadIdx.x & 31) == 0) most[threadIdx.x / 32] = warp_furthest;
  __syncthreads();
  int furthest = -1;
  for (int i = 0; i < kWarps; ++i) furthest = max(furthest, most[i]);
  return furthest;
}

// A splat of the list and the row of its instance there; beyond the list one that reaches no pixel.
struct Listed {
  Record<kChannels> record;
  int instance;
};
__device__ inline Listed listed(const FrameLists& lists, int position, int begin, int end) {
  if (position < begin || position >= end) return {faint_record<kChannels>(), 0};
  const int instance = lists.sorted[position];
  return {static_cast<const Record<kChannels>*>(lists.records)[lists.instance_splats[instance]], instance};
}

// Adds a pixel's part of the row and moves the pixel in front of the splat.
__device__ inline void add_pixel(const Record<kChannels>& r, const Falloff& f, Pixel& pixel, float* v) {
  const float alpha = exp2_fast(fminf(f.power, kOpaque)), widen = reciprocal(1 - alpha), through = pixel.through * widen;
  const float weight = alpha * through;
  float g = 0;
  for (int d = 0; d < kChannels; ++d) {
    g = fmaf(pixel.v_color[d], r.colors[d], g);
    v[kShapeMoments + d] = fmaf(weight, pixel.v_color[d], v[kShapeMoments + d]);
  }
  const float v_alpha = fmaf(through, g, -(pixel.behind * widen));
  pixel.through = through;
  pixel.behind = fmaf(weight, g, pixel.behind);
  // A splat at the ceiling of 0.99 passes nothing on to its opacity and shape.
  const float s = f.power <= kOpaque ? alpha * v_alpha : 0, sx = s * f.dx, sy = s * f.dy;
  v[0] += s;
  v[1] += sx;
  v[2] += sy;
  v[3] = fmaf(sx, f.dx, v[3]);
  v[4] = fmaf(sx, f.dy, v[4]);
  v[5] = fmaf(sy, f.dy, v[5]);
}

__global__ void __launch_bounds__(kBlockThreads, 8) backward_tiles(FrameScene scene, FrameLists lists, FrameGradients from) {
  __shared__ Record<kChannels> staged[kBatch];
  __shared__ int instances[kBatch];
  __shared__ float4 sums[kWarps][kBatch][kRowQuads];
  __shared__ unsigned touched[kWarps][kBatch / 32];
  if (lists.status[kStatusCut] != 0) return;
  const Tile tile(scene, lists);
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32;
  Pixel pixels[kPixelsEach];
  int warp_furthest = -1;
  for (int p = 0; p < kPixelsEach; ++p) {
    pixels[p] = start_pixel(scene, from, tile.x, tile.quadrant_y + lane / kQuadrant + p * (kQuadrant / kPixelsEach));
    warp_furthest = max(warp_furthest, pixels[p].last);
  }
  warp_furthest = __reduce_max_sync(kAll, warp_furthest);
  const int furthest = min(block_furthest(warp_furthest), tile.end - 1);
  const int end = max(furthest + 1, tile.begin);
  for (int e = threadIdx.x; e < (tile.end - end) * kRowQuads; e += kBlockThreads)
    from.rows[int64_t(lists.sorted[end + e / kRowQuads]) * kRowQuads + e % kRowQuads] = make_float4(0, 0, 0, 0);
  if (furthest < tile.begin) return;

  const float center_x = float(tile.x) + 0.5f;
  const float quadrant_x = float(tile.quadrant_x) + 0.5f, quadrant_y = float(tile.quadrant_y) + 0.5f;
  int first = tile.begin + (furthest - tile.begin) / kBatch * kBatch;
  Listed next = {};
  if (threadIdx.x < kBatch) next = listed(lists, first + threadIdx.x, tile.begin, end);
  for (; first >= tile.begin; first -= kBatch) {
    if (threadIdx.x < kBatch) {
      staged[threadIdx.x] = next.record;
      instances[threadIdx.x] = next.instance;
    }
    __syncthreads();
    if (threadIdx.x < kBatch) next = listed(lists, first - kBatch + threadIdx.x, tile.begin, end);  // on its way meanwhile
    for (int group = kBatch - 32; group >= 0; group -= 32) {
      const bool needed = first + group + lane <= warp_furthest && reaches(staged[group + lane], quadrant_x, quadrant_y);
      unsigned hits = __ballot_sync(kAll, needed), used = 0;
      while (hits != 0) {
        const int bit = 31 - __clz(int(hits)), i = group + bit;
        hits ^= 1u << bit;
        const Record<kChannels>& r = staged[i];
        Falloff f[kPixelsEach];
        bool valid[kPixelsEach], any = false;
        for (int p = 0; p < kPixelsEach; ++p) {
          f[p] = falloff(r, center_x, pixels[p].center_y);
          valid[p] = f[p].power >= kFaintest && first + i <= pixels[p].last;
          any |= valid[p];
        }
        if (!__any_sync(kAll, any)) continue;
        float v[kValues] = {};
#pragma unroll
        for (int p = 0; p < kPixelsEach; ++p)
          if (valid[p]) add_pixel(r, f[p], pixels[p], v);
        const float sum = warp_sums<kValues / 2>(v, lane);
        if ((lane & 1) == 0 && lane / 2 < 4 * kRowQuads) reinterpret_cast<float*>(sums[warp][i])[lane / 2] = sum;
        used |= 1u << bit;
      }
      if (lane == 0) touched[warp][group / 32] = used;
    }
    __syncthreads();
    const int count = min(end - first, kBatch);
    for (int e = threadIdx.x; e < count * kRowQuads; e += kBlockThreads) {
      const int i = e / kRowQuads, q = e % kRowQuads;
      float4 sum = make_float4(0, 0, 0, 0);
      for (int w = 0; w < kWarps; ++w) {
        if ((touched[w][i / 32] >> (i % 32) & 1) == 0) continue;
        const float4 part = sums[w][i][q];
        sum = make_float4(sum.x + part.x, sum.y + part.y, sum.z + part.z, sum.w + part.w);
      }
      from.rows[int64_t(instances[i]) * kRowQuads + q] = sum;
    }
    __syncthreads();
  }
}

}  // namespace

void instance_gradients_on_device(const FrameScene& scene, const FrameLists& lists, const FrameGradients& from,
                                  cudaStream_t stream) {
  if (scene.tiles() == 0) return;
  backward_tiles<<<unsigned(scene.tiles()), kBlockThreads, 0, stream>>>(scene, lists, from);
}
