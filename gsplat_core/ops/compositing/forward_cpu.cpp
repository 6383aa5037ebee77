// CPU kernels of alpha compositing: splat records and front-to-back blending.
#include "blocks.h"

namespace GSPLAT_ISA::compositing {

namespace {

constexpr float kLog2E = 1.44269504f;
constexpr int kBatch = 64;  // splats per pass over the blocks: one bit each in a block's 64-bit mask

// State of a window's pixels between batches, block by block. It has D channels, or `channels` if D is 0.
struct Window {
  float* through;  // transmittance after all splats so far, including those after termination
  float* kept;     // transmittance after the last blended splat
  int32_t* last;
  float* colors;  // [channels][kPixels]
};

template <int D>
void blend_block(const Splats& in, const int32_t* ids, int64_t position, uint64_t splats, vfloat x, vfloat y, const Window& w,
                 int block, uint64_t& alive) {
  const int at = block * kLanes;
  vfloat through = load(w.through + at), kept = load(w.kept + at);
  vint last;
  __builtin_memcpy(&last, w.last + at, sizeof(last));
  vfloat sum[D > 0 ? D : 1];
  for (int d = 0; d < D; ++d) sum[d] = load(w.colors + d * kPixels + at);
  for (; splats != 0; splats &= splats - 1) {
    const int i = __builtin_ctzll(splats);
    const SplatRecord& record = in.records[ids[i]];
    const vfloat power = falloff(record, x, y).power;
    const vmask valid = at_least(power, splat(kLog2AlphaCutoff)) & at_least(splat(record.cap), power);
    const vfloat alpha = zero_unless(valid, exp2(smaller(power, splat(in.alpha.log2_most))));
    const vfloat next = fma(-alpha, through, through);
    // After termination the transmittance only decreases, so this test keeps a terminated pixel closed.
    const vmask open = above(next, splat(kMinTransmittance));
    const vfloat weight = zero_unless(open, alpha * through);
    if constexpr (D > 0) {
      for (int d = 0; d < D; ++d) sum[d] = fma(weight, splat(record.colors[d]), sum[d]);
    } else {
      const float* color = in.colors + int64_t(ids[i]) * in.channels;
      for (int d = 0; d < in.channels; ++d) {
        float* const to = w.colors + d * kPixels + at;
        store(to, fma(weight, splat(color[d]), load(to)));
      }
    }
    last = where(vmask(open & valid), splat_int(int32_t(position + i)), last);
    kept = where(open, next, kept);
    through = next;
    if (lanes_of(open) == 0) {
      alive &= ~(uint64_t(1) << block);
      break;
    }
  }
  store(w.through + at, through);
  store(w.kept + at, kept);
  __builtin_memcpy(w.last + at, &last, sizeof(last));
  for (int d = 0; d < D; ++d) store(w.colors + d * kPixels + at, sum[d]);
}

GSPLAT_INLINE void write_pixel(const Window& w, int at, int channels, int64_t pixel, const Pixels& out) {
  out.alphas[pixel] = 1 - w.kept[at];
  out.last[pixel] = w.last[at];
  for (int d = 0; d < channels; ++d) out.colors[pixel * channels + d] = w.colors[d * kPixels + at];
}

template <int D>
void blend_window(const Splats& in, const Tile& tile, int x0, int y0, const Pixels& out, float* scratch) {
  const int width = tile.right - x0 < kWindow ? tile.right - x0 : kWindow;
  const int height = tile.bottom - y0 < kWindow ? tile.bottom - y0 : kWindow;
  alignas(64) float through[kPixels], kept[kPixels];
  alignas(64) int32_t last[kPixels];
  const int channels = D > 0 ? D : in.channels;
  alignas(64) float own_colors[D > 0 ? D * kPixels : 1];
  const Window w = {through, kept, last, D > 0 ? own_colors : scratch};
  for (int i = 0; i < channels * kPixels; ++i) w.colors[i] = 0;
  uint64_t alive = 0;
  for (int i = 0; i < kPixels; ++i) through[i] = 0, kept[i] = 1, last[i] = -1;
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; x += kBlockWidth) {
      const int at = place(x, y);
      for (int i = 0; i < kBlockWidth && x + i < width; ++i) through[at + i] = 1;
      alive |= uint64_t(1) << (at / kLanes);
    }
  const vfloat block_x = lane_x() + (float(x0) + 0.5f), block_y = lane_y() + (float(y0) + 0.5f);
  for (int64_t first = tile.begin; first < tile.end && alive != 0; first += kBatch) {
    const int32_t* const ids = in.flatten_ids + first;
    const int count = tile.end - first < kBatch ? int(tile.end - first) : kBatch;
    prefetch_records(in, first + kBatch, kBatch);
    uint64_t splats[kBlocks] = {};
    for (int i = 0; i < count; i += kLanes)
      test_blocks(in.records, ids + i, count - i, float(x0) + 0.5f, float(y0) + 0.5f,
                  [&](int block, vmask hit) { splats[block] |= uint64_t(lanes_of(hit)) << i; });
    for (uint64_t left = alive; left != 0; left &= left - 1) {
      const int block = __builtin_ctzll(left);
      if (splats[block] == 0) continue;
      blend_block<D>(in, ids, first, splats[block], block_x + float(block % kColumns * kBlockWidth),
                     block_y + float(block / kColumns * kBlockHeight), w, block, alive);
    }
  }
  const float* const background = in.backgrounds != nullptr ? in.backgrounds + tile.image * channels : nullptr;
  for (int y = 0; y < height; ++y) {
    const int64_t row = (tile.image * in.height + y0 + y) * in.width + x0;
    for (int x = 0; x < width; x += kBlockWidth) {
      const int at = place(x, y), count = width - x < kBlockWidth ? width - x : kBlockWidth;
      const int64_t pixel = row + x;
      if (background != nullptr)
        for (int d = 0; d < channels; ++d) {
          float* const color = w.colors + d * kPixels + at;
          store_quad(color, load_quad(color) + load_quad(kept + at) * background[d]);
        }
      if (count < kBlockWidth) {
        for (int i = 0; i < count; ++i) write_pixel(w, at + i, channels, pixel + i, out);
        continue;
      }
      store_quad(out.alphas + pixel, 1.0f - load_quad(kept + at));
      __builtin_memcpy(out.last + pixel, last + at, kBlockWidth * sizeof(int32_t));
      float* const to = out.colors + pixel * channels;
      const float* const from = w.colors + at;
      if constexpr (D == 4) {
        quad a = load_quad(from), b = load_quad(from + kPixels), c = load_quad(from + 2 * kPixels),
             d = load_quad(from + 3 * kPixels);
        transpose(a, b, c, d);
        store_quad(to, a), store_quad(to + 4, b), store_quad(to + 8, c), store_quad(to + 12, d);
      } else {
        for (int i = 0; i < kBlockWidth; ++i)
          for (int d = 0; d < channels; ++d) to[i * channels + d] = from[d * kPixels + i];
      }
    }
  }
}

template <int D>
void blend_tile(const Splats& in, Tile tile, const Pixels& out, float* scratch) {
  if (tile.masked) tile.end = tile.begin;  // a masked tile shows only the background
  for (int y = tile.y; y < tile.bottom; y += kWindow)
    for (int x = tile.x; x < tile.right; x += kWindow) blend_window<D>(in, tile, x, y, out, scratch);
}

}  // namespace

void make_records(const Inputs& in, int64_t begin, int64_t end, SplatRecord* records) {
  const int channels = in.channels;
  for (int64_t first = begin; first < end; first += kLanes) {
    const int n = end - first < kLanes ? int(end - first) : kLanes;
    float logs[kLanes] = {};
    for (int i = 0; i < n; ++i) logs[i] = in.opacities[first + i];
    const vfloat opacity = load(logs);
    store(logs, where(above(opacity, vfloat{}), log2(opacity), splat(-__builtin_inff())));
    for (int i = 0; i < n; ++i) {
      const int64_t splat = first + i;
      const float *mean = in.means2d + 2 * splat, *conic = in.conics + 3 * splat, *color = in.colors + channels * splat;
      SplatRecord& r = records[splat];
      const float a = conic[0], b = conic[1], c = conic[2];
      // 0 times a non-finite value is NaN, so the sum is NaN if any value is not finite.
      float check = 0 * mean[0] + 0 * mean[1] + 0 * a + 0 * b + 0 * c + 0 * in.opacities[splat];
      for (int d = 0; d < channels; ++d) check += 0 * color[d];
      const bool usable = check == 0;
      const bool indefinite = !(a >= 0 && c >= 0 && a * c - b * b >= 0);
      r.x = usable ? mean[0] : 0;
      r.y = usable ? mean[1] : 0;
      r.a = usable ? -0.5f * kLog2E * a : 0;
      r.b = usable ? -kLog2E * b : 0;
      r.c = usable ? -0.5f * kLog2E * c : 0;
      r.l = usable ? logs[i] : -__builtin_inff();
      r.cap = indefinite ? r.l : __builtin_inff();
      r.unused = 0;
      if (channels <= kMaxRecordChannels)
        for (int d = 0; d < channels; ++d) r.colors[d] = color[d];
    }
  }
}

// Return the scratch memory of one thread: colours (forward) or their gradients (backward) of a window, in the backward
// pass followed by a splat's sums per lane and in total.
int64_t scratch_floats(int channels) { return int64_t(channels) * (kPixels + kLanes + 1); }

void composite_tile(const Splats& in, int64_t tile, const Pixels& out, float* scratch) {
  const Tile t = tile_of(in, tile);
  switch (in.channels) {
    case 1: return blend_tile<1>(in, t, out, scratch);
    case 3: return blend_tile<3>(in, t, out, scratch);
    case 4: return blend_tile<4>(in, t, out, scratch);
    case 5: return blend_tile<5>(in, t, out, scratch);
    default: return blend_tile<0>(in, t, out, scratch);
  }
}

extern const Kernels kernels = {make_records, scratch_floats, composite_tile, composite_tile_backward, gather};

}  // namespace GSPLAT_ISA::compositing
