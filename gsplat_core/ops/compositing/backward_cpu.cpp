// Gradient of compositing, traversed back to front from the saved transmittance.
//
// With w_i = alpha_i T_i the weight of splat i and g_i = <dL/dcolour, c_i> at a pixel, dL/dalpha_i = T_i g_i - (sum of
// w_j g_j behind i, including the background) / (1 - alpha_i). One running sum per pixel therefore serves all channels.
// Only moments of s = alpha dL/dalpha are summed over pixels; the gradients of mean, conic and opacity follow from them
// once per splat. Every instance (a splat in a tile) has its own gradient row, and a splat's rows are summed in a fixed
// order without atomics. The result is bitwise identical for any number of threads.
#include "blocks.h"

namespace GSPLAT_ISA::compositing {

namespace {

constexpr float kLn2 = 0.69314718f;

// State of a window's pixels, ordered block by block.
struct Window {
  float* through;  // transmittance in front of the splats visited so far (from the back)
  float* behind;   // sum of w g of the splats behind
  int32_t* last;
  float* v_colors;  // [channels][kPixels]
};

// Process one splat over its blocks; add its moments, colours and absolute gradients to `sum`.
template <int D, bool kAbs>
GSPLAT_INLINE void splat_backward(const Splats& in, int32_t id, int64_t position, uint64_t blocks, vfloat block_x, vfloat block_y,
                                  const Window& w, vfloat* sum, vfloat* color_sum) {
  const SplatRecord& record = in.records[id];
  const float* const color = D > 0 ? record.colors : in.colors + int64_t(id) * in.channels;
  const int channels = D > 0 ? D : in.channels;
  for (; blocks != 0; blocks &= blocks - 1) {
    const int block = __builtin_ctzll(blocks), at = block * kLanes;
    const Falloff f =
        falloff(record, block_x + float(block % kColumns * kBlockWidth), block_y + float(block / kColumns * kBlockHeight));
    vint last;
    __builtin_memcpy(&last, w.last + at, sizeof(last));
    const vmask valid = at_least(f.power, splat(kLog2AlphaCutoff)) & at_least(splat(record.cap), f.power) &
                        at_least(last, splat_int(int32_t(position)));
    const vfloat alpha = zero_unless(valid, exp2(smaller(f.power, splat(in.alpha.log2_most))));
    const vfloat widen = reciprocal(1.0f - alpha);
    const vfloat through = load(w.through + at) * widen, weight = alpha * through;
    vfloat g = {};
    for (int d = 0; d < channels; ++d) {
      const vfloat v = load(w.v_colors + d * kPixels + at);
      g = fma(v, splat(color[d]), g);
      color_sum[d] = fma(weight, v, color_sum[d]);
    }
    const vfloat behind = load(w.behind + at);
    const vfloat v_alpha = fma(through, g, -(behind * widen));
    store(w.through + at, through);
    store(w.behind + at, fma(weight, g, behind));
    // Where alpha is clamped to its maximum, opacity and shape have no gradient.
    const vfloat s = zero_unless(valid & at_least(splat(in.alpha.log2_most), f.power), alpha * v_alpha);
    const vfloat sx = s * f.dx, sy = s * f.dy;
    sum[0] = sum[0] + s;
    sum[1] = sum[1] + sx;
    sum[2] = sum[2] + sy;
    sum[3] = fma(sx, f.dx, sum[3]);
    sum[4] = fma(sx, f.dy, sum[4]);
    sum[5] = fma(sy, f.dy, sum[5]);
    if constexpr (kAbs) {
      const float a = -2 * kLn2 * record.a, b = -kLn2 * record.b, c = -2 * kLn2 * record.c;
      const vfloat x = fma(sy, splat(b), sx * a), y = fma(sy, splat(c), sx * b);
      sum[kMoments] = sum[kMoments] + larger(x, -x);
      sum[kMoments + 1] = sum[kMoments + 1] + larger(y, -y);
    }
  }
}

GSPLAT_INLINE void put(float* to, const float* from, int count, bool add) {
  for (int i = 0; i < count; ++i) to[i] = add ? to[i] + from[i] : from[i];
}

template <int D, bool kAbs>
void window_backward(const Splats& in, const Tile& tile, int x0, int y0, int64_t tile_index, bool add,
                     const PictureGradient& from, const GradientRows& out, float* scratch) {
  const int width = tile.right - x0 < kWindow ? tile.right - x0 : kWindow;
  const int height = tile.bottom - y0 < kWindow ? tile.bottom - y0 : kWindow;
  const int channels = D > 0 ? D : in.channels, abs_at = kMoments + channels;
  alignas(64) float through[kPixels], behind[kPixels];
  alignas(64) int32_t last[kPixels];
  alignas(64) float own_v_colors[D > 0 ? D * kPixels : 1];
  const Window w = {through, behind, last, D > 0 ? own_v_colors : scratch};
  vfloat* const far_sums = (vfloat*)(scratch + channels * kPixels);  // of the colours, if D is 0
  float* const far_row = scratch + channels * (kPixels + kLanes);

  const float* const background = in.backgrounds != nullptr ? in.backgrounds + tile.image * channels : nullptr;
  for (int i = 0; i < kPixels; ++i) through[i] = 1, behind[i] = 0, last[i] = -1;
  for (int i = 0; i < channels * kPixels; ++i) w.v_colors[i] = 0;
  vint block_last[kBlocks];
  int32_t furthest = -1;
  for (int y = 0; y < height; ++y) {
    const int64_t row = (tile.image * in.height + y0 + y) * in.width + x0;
    for (int x = 0; x < width; x += kBlockWidth) {
      const int at = place(x, y), count = width - x < kBlockWidth ? width - x : kBlockWidth;
      const int64_t pixel = row + x;
      const float* const source = from.v_colors + pixel * channels;
      float* const to = w.v_colors + at;
      quad left = {1, 1, 1, 1}, v_left = {};
      if (count == kBlockWidth) {
        left = 1.0f - load_quad(from.alphas + pixel);
        v_left = -load_quad(from.v_alphas + pixel);
        __builtin_memcpy(last + at, from.last + pixel, kBlockWidth * sizeof(int32_t));
      } else {
        for (int i = 0; i < count; ++i) {
          left[i] = 1 - from.alphas[pixel + i];
          v_left[i] = -from.v_alphas[pixel + i];
          last[at + i] = from.last[pixel + i];
        }
      }
      if (D == 4 && count == kBlockWidth) {
        quad a = load_quad(source), b = load_quad(source + 4), c = load_quad(source + 8), d = load_quad(source + 12);
        transpose(a, b, c, d);
        store_quad(to, a), store_quad(to + kPixels, b), store_quad(to + 2 * kPixels, c), store_quad(to + 3 * kPixels, d);
      } else {
        for (int i = 0; i < count; ++i)
          for (int d = 0; d < channels; ++d) to[d * kPixels + i] = source[i * channels + d];
      }
      if (background != nullptr)
        for (int d = 0; d < channels; ++d) {
          const quad v = load_quad(to + d * kPixels), shown = v * left;
          v_left += v * background[d];
          out.v_backgrounds[tile_index * channels + d] += (shown[0] + shown[1]) + (shown[2] + shown[3]);
        }
      store_quad(through + at, left);
      store_quad(behind + at, left * v_left);
    }
  }
  for (int block = 0; block < kBlocks; ++block) {
    int32_t most = -1;
    for (int i = 0; i < kLanes; ++i) most = last[block * kLanes + i] > most ? last[block * kLanes + i] : most;
    block_last[block] = splat_int(most);
    furthest = most > furthest ? most : furthest;
  }

  const vfloat block_x = lane_x() + (float(x0) + 0.5f), block_y = lane_y() + (float(y0) + 0.5f);
  const vint lane = __builtin_convertvector(ramp(), vint);
  for (int64_t first = tile.begin + (tile.end - tile.begin - 1) / kLanes * kLanes; first >= tile.begin && first < tile.end;
       first -= kLanes) {
    const int count = tile.end - first < kLanes ? int(tile.end - first) : kLanes;
    const int64_t ahead = first - 2 * kLanes > tile.begin ? first - 2 * kLanes : tile.begin;
    prefetch_records(in, ahead, kLanes);
    for (int64_t i = ahead; i < ahead + kLanes && i < tile.end; ++i)
      __builtin_prefetch(out.rows + int64_t(out.row_of[i]) * out.row_size, 1);
    constexpr int kHalves = (kBlocks + 31) / 32;  // bit set of a splat's blocks, 32 per int
    alignas(64) uint32_t touched[kHalves][kLanes] = {};
    if (first <= furthest) {
      vint sets[kHalves] = {};
      const vint positions = splat_int(int32_t(first)) + lane;
      test_blocks(in.records, in.flatten_ids + first, count, float(x0) + 0.5f, float(y0) + 0.5f, [&](int block, vmask hit) {
        const vmask in_use = hit & at_least(block_last[block], positions);
        sets[block / 32] = or_where(in_use, sets[block / 32], int32_t(1u << (block % 32)));
      });
      __builtin_memcpy(touched, sets, sizeof(touched));
    }
    for (int i = count - 1; i >= 0; --i) {
      const int64_t position = first + i;
      float* const to = out.rows + int64_t(out.row_of[position]) * out.row_size;
      uint64_t blocks = touched[0][i];
      if constexpr (kHalves > 1) blocks |= uint64_t(touched[kHalves - 1][i]) << 32;
      if (blocks == 0) {
        if (!add)
          for (int r = 0; r < out.row_size; ++r) to[r] = 0;
        continue;
      }
      constexpr int kShape = kMoments + (kAbs ? 2 : 0);
      const int32_t id = in.flatten_ids[position];
      if constexpr (D > 0) {
        vfloat sum[kShape] = {}, color_sum[D] = {}, all[kShape + D];
        splat_backward<D, kAbs>(in, id, position, blocks, block_x, block_y, w, sum, color_sum);
        for (int r = 0; r < kMoments; ++r) all[r] = sum[r];
        for (int d = 0; d < D; ++d) all[kMoments + d] = color_sum[d];
        for (int r = kMoments; r < kShape; ++r) all[r + D] = sum[r];
        if (add) {
          float row[kShape + D];
          sums<kShape + D>(all, row);
          put(to, row, kShape + D, true);
        } else {
          sums<kShape + D>(all, to);
        }
      } else {
        vfloat shape_sum[kShape] = {};
        for (int d = 0; d < channels; ++d) far_sums[d] = vfloat{};
        splat_backward<D, kAbs>(in, id, position, blocks, block_x, block_y, w, shape_sum, far_sums);
        float shape[kShape];
        sums<kShape>(shape_sum, shape);
        for (int d = 0; d < channels; ++d) far_row[d] = sum(far_sums[d]);
        put(to, shape, kMoments, add);
        put(to + kMoments, far_row, channels, add);
        put(to + abs_at, shape + kMoments, kShape - kMoments, add);
      }
    }
  }
}

template <int D, bool kAbs>
void tile_backward(const Splats& in, int64_t index, const PictureGradient& from, const GradientRows& out, float* scratch) {
  const Tile tile = tile_of(in, index);
  bool add = false;
  for (int y = tile.y; y < tile.bottom; y += kWindow)
    for (int x = tile.x; x < tile.right; x += kWindow, add = true)
      window_backward<D, kAbs>(in, tile, x, y, index, add, from, out, scratch);
  if (!add) {  // tile outside of the image: its instances reach no pixel
    for (int64_t position = tile.begin; position < tile.end; ++position)
      for (int64_t r = 0; r < out.row_size; ++r) out.rows[out.row_of[position] * out.row_size + r] = 0;
  }
}

template <int D>
void tile_backward(const Splats& in, int64_t index, const PictureGradient& from, const GradientRows& out, float* scratch) {
  return out.absgrad ? tile_backward<D, true>(in, index, from, out, scratch)
                     : tile_backward<D, false>(in, index, from, out, scratch);
}

}  // namespace

void composite_tile_backward(const Splats& in, int64_t tile, const PictureGradient& from, const GradientRows& out,
                             float* scratch) {
  switch (in.channels) {
    case 1: return tile_backward<1>(in, tile, from, out, scratch);
    case 3: return tile_backward<3>(in, tile, from, out, scratch);
    case 4: return tile_backward<4>(in, tile, from, out, scratch);
    case 5: return tile_backward<5>(in, tile, from, out, scratch);
    default: return tile_backward<0>(in, tile, from, out, scratch);
  }
}

void gather(const Splats& in, const GradientRows& from, const int32_t* first, int64_t begin, int64_t end,
            const InputGradients& out) {
  const int channels = in.channels;
  for (int64_t splat = begin; splat < end; ++splat) {
    float m[kMoments] = {}, absolute[2] = {};
    float* const v_color = out.colors + channels * splat;
    for (int d = 0; d < channels; ++d) v_color[d] = 0;
    const bool usable = in.records[splat].l > -__builtin_inff();
    for (int64_t i = first[splat]; usable && i < first[splat + 1]; ++i) {
      const float* const row = from.rows + i * from.row_size;
      for (int r = 0; r < kMoments; ++r) m[r] += row[r];
      for (int d = 0; d < channels; ++d) v_color[d] += row[kMoments + d];
      if (from.absgrad)
        for (int r = 0; r < 2; ++r) absolute[r] += row[kMoments + channels + r];
    }
    const float a = usable ? in.conics[3 * splat] : 0, b = usable ? in.conics[3 * splat + 1] : 0;
    const float c = usable ? in.conics[3 * splat + 2] : 0;
    out.means2d[2 * splat] = a * m[1] + b * m[2];
    out.means2d[2 * splat + 1] = b * m[1] + c * m[2];
    out.conics[3 * splat] = -0.5f * m[3];
    out.conics[3 * splat + 1] = -m[4];
    out.conics[3 * splat + 2] = -0.5f * m[5];
    out.opacities[splat] = usable ? m[0] / in.opacities[splat] : 0;
    for (int r = 0; from.absgrad && r < 2; ++r) out.absolute[2 * splat + r] = absolute[r];
  }
}

}  // namespace GSPLAT_ISA::compositing
