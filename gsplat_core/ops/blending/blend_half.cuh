// Front-to-back blending of one window with one block of kBlockThreads threads, in half precision on tensor cores.
#pragma once

#include "blend_forward.cuh"
#include "half_precision.cuh"

namespace gsplat::blending {
namespace {

constexpr int kHalfBatch = 3 * kBlockThreads;  // splats staged per batch
constexpr int kHalfTiles = 4;                  // tiles of eight splats blended per step
constexpr int kHalfStep = 8 * kHalfTiles;

// A staged splat: the fetched record, later overwritten by the operands of the matrix products.
union HalfSlot {
  Record<4> record;
  HalfSplat splat;
};

// Sums of one pixel: red and green, blue and depth, the weights (in units of kMaxAlpha) and an unused value.
struct PixelSums {
  float2 pairs[3];
};

// Shared memory of a block of the kernel blend_half.
struct HalfStage {
  HalfSlot slots[kHalfBatch];
  HalfSplat none;                                          // a splat that reaches no pixel
  uint4 reaching[2 * kWarps][kHalfBatch / kBlockThreads];  // per half quadrant: bits of the batch's splats
  union {
    uint16_t hits[kHalfBatch + kHalfStep / 2];  // shared-memory addresses of the splats that reach the half quadrant
    PixelSums sums[kQuadrant * kQuadrant];      // used after all splats are blended
  } of_warp[kWarps];
};

// Half of a warp's quadrant: 8x4 pixels.
struct HalfPart {
  HalfPixels pixels[2];
  bool open;

  __device__ HalfPart(const Window& w, int half) {
    const WarpPlace place;
    const int x = w.quadrant_x + place.group, top = w.quadrant_y + 4 * half;
#pragma unroll
    for (int i = 0; i < 2; ++i) {
      const int y = top + 2 * i;
      pixels[i].front = __floats2half2_rn(x < w.right && y < w.bottom ? 1 : 0, x < w.right && y + 1 < w.bottom ? 1 : 0);
      for (float& sum : pixels[i].sums) sum = 0;
    }
    open = w.quadrant_x < w.right && top < w.bottom;
  }

  // Blend the `count` splats whose addresses are at `hits`; `count` is a multiple of half a step. (basis, y) is the
  // upper left pixel.
  __device__ void blend(const PixelBasis& basis, float y, uint32_t hits, int count) {
    uint32_t rows[2][4];
    basis.fill(y, rows[0]);
    basis.fill(y + 2, rows[1]);
    for (; count >= kHalfStep && open; count -= kHalfStep, hits += kHalfStep * sizeof(uint16_t))
      blend_step<kHalfTiles>(rows, hits);
    if (count > 0 && open) blend_step<kHalfTiles / 2>(rows, hits);
  }

  // Store the sums in shared memory for the threads that write the pixels.
  __device__ void store_sums(PixelSums* sums) const {
    const WarpPlace place;
    if (place.quad == 3) return;
#pragma unroll
    for (int row = 0; row < 4; ++row) {
      const float* const pair = &pixels[row / 2].sums[row % 2 * 2];
      sums[kQuadrant * row + place.group].pairs[place.quad] = {pair[0], pair[1]};
    }
  }

 private:
  template <int kTiles>
  __device__ void blend_step(const uint32_t (&rows)[2][4], uint32_t hits) {
    const HalfSplats<kTiles> splats(hits);
    HalfWeights<kTiles> upper(pixels[0], rows[0], splats), lower(pixels[1], rows[1], splats);
    const bool closing = __any_sync(kAll, upper.closes(pixels[0]) || lower.closes(pixels[1]));
    if (closing) {
      upper.cut();
      lower.cut();
    }
    upper.blend(splats, pixels[0]);
    lower.blend(splats, pixels[1]);
    if (closing) open = __any_sync(kAll, pixels[0].open() || pixels[1].open());
  }
};

// List at `hits` the splats of a batch of `count` that reach a part of the window, padded with `none` to a multiple of
// half a step. Return their number. `first` is the address of the batch's first splat.
__device__ inline int list_reaching(const uint4* reaching, int count, uint32_t first, uint32_t none, uint32_t hits) {
  const int lane = threadIdx.x & 31;
  const unsigned mine = 1u << lane;
  const auto store = [&](int at, uint32_t hit) { store_hit(hits + uint32_t(at * sizeof(uint16_t)), hit); };
  uint32_t splat = first + uint32_t(lane * sizeof(HalfSlot));
  int listed = 0;
  __syncwarp();
  for (int i = 0; i * kBlockThreads < count; ++i) {
    const uint4 bits = reaching[i];
    const unsigned groups[4] = {bits.x, bits.y, bits.z, bits.w};
#pragma unroll
    for (const unsigned group : groups) {
      if (group & mine) store(listed + __popc(group & (mine - 1)), splat);
      listed += __popc(group);
      splat += 32 * sizeof(HalfSlot);
    }
  }
  const int missing = -listed & (kHalfStep / 2 - 1);
  if (lane < missing) store(listed + lane, none);
  __syncwarp();
  return listed + missing;
}

// Start asynchronous copies of the records of `count` splats from position `begin` on. record_of(position) returns a
// pointer or null.
template <class Find>
__device__ inline void fetch_batch(const Find& record_of, int begin, int count, HalfSlot* slots) {
  for (int i = threadIdx.x; i < count; i += kBlockThreads) {
    const Record<4>* const record = record_of(begin + i);
    if (record == nullptr)
      slots[i].record = faint_record<4>();
    else
      for (int j = 0; j < 3; ++j) copy_16(reinterpret_cast<uint4*>(&slots[i]) + j, reinterpret_cast<const uint4*>(record) + j);
  }
}

// Wait for the records that this thread fetched, stage them, and store the masks of the splats that reach each part of
// the window.
__device__ inline void stage_batch(const Window& w, int count, float per_depth, HalfStage& stage) {
  const int lane = threadIdx.x % 32;
  wait_for_copies();
  for (int first = threadIdx.x / 32 * 32; first < (count + kBlockThreads - 1) / kBlockThreads * kBlockThreads;
       first += kBlockThreads) {
    unsigned reaching = 0;
    if (first < count) {
      HalfSlot& slot = stage.slots[first + lane];
      const Record<4> r = slot.record;
      const bool shown = stage_half_splat(r, float(w.left + kQuadrant), float(w.top + kQuadrant), per_depth, slot.splat);
      reaching = reaching_parts<kQuadrant / 2>(shown && first + lane < count, r, float(w.left) + 0.5f, float(w.top) + 0.5f);
    }
    if (lane < 2 * kWarps) reinterpret_cast<unsigned*>(stage.reaching[lane])[first / 32] = reaching;
  }
}

// Blend a window. `record_of(position)` returns a pointer to the splat at a position in [w.begin, w.end), in depth
// order, or null if there is no splat. The last channel is the depth. All threads of the block must call it. `last` is
// not computed.
template <class Find>
__device__ inline BlendedPixels<4> blend_half(const Window& w, const Find& record_of, HalfStage& stage) {
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32, part = warp / 2 * 4 + warp % 2;
  auto& of_warp = stage.of_warp[warp];
  const uint32_t first = shared_address(stage.slots), none = shared_address(&stage.none), hits = shared_address(&of_warp);
  const PixelBasis basis(lane % 4, float(w.quadrant_x - w.left - kQuadrant + lane / 4) + 0.5f);
  const float y = float(w.quadrant_y - w.top - kQuadrant) + 0.5f;
  HalfPart upper(w, 0), lower(w, 1);
  float unit = 0;  // scale of the depth, to fit the range of half precision
  if (threadIdx.x == 0) stage.none = {{pack_halves(-kGreatestHalf, 0), 0, 0, 0}, {}, {}};
  for (int begin = w.begin; begin < w.end; begin += kHalfBatch) {
    if (begin > w.begin && !__syncthreads_or(upper.open || lower.open)) break;
    const int count = min(w.end - begin, kHalfBatch);
    fetch_batch(record_of, begin, count, stage.slots);
    if (begin == w.begin) {
      const Record<4>* const last = record_of(w.end - 1);
      const float deepest = last != nullptr ? last->colors[3] : 0;
      unit = deepest > 0 ? deepest * 0x1p-15f : 1;
    }
    stage_batch(w, count, reciprocal(unit), stage);
    __syncthreads();
    if (upper.open) upper.blend(basis, y, hits, list_reaching(stage.reaching[part], count, first, none, hits));
    if (lower.open) lower.blend(basis, y + 4, hits, list_reaching(stage.reaching[part + 2], count, first, none, hits));
  }
  __syncwarp();
  upper.store_sums(of_warp.sums);
  lower.store_sums(of_warp.sums + kQuadrant * kQuadrant / 2);
  __syncwarp();
  BlendedPixels<4> out;
  for (int p = 0; p < kPixelsEach; ++p) {
    const PixelSums& sums = of_warp.sums[kQuadrant * row_of_lane(lane, p) + lane % kQuadrant];
    out.through[p] = fmaxf(fmaf(-kMaxAlpha, sums.pairs[2].x, 1.0f), 0);
    out.sum[p][0] = kMaxAlpha * sums.pairs[0].x;
    out.sum[p][1] = kMaxAlpha * sums.pairs[0].y;
    out.sum[p][2] = kMaxAlpha * sums.pairs[1].x;
    out.sum[p][3] = kMaxAlpha * unit * sums.pairs[1].y;
  }
  return out;
}

}  // namespace

}  // namespace gsplat::blending
