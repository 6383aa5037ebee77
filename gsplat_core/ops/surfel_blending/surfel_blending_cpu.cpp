// Front-to-back blending of surfels and its gradient, traversed back to front from the saved transmittance.
//
// Pixels are processed in blocks of one vector in windows of 16x16 pixels, as in ../compositing. With w_i the weight of
// surfel i, A_i and S_i the sums of w_j and w_j z_j in front of it, and A and S the sums of all, the distortion sum_i 2 w_i
// (z_i A_i - S_i) has the derivatives 2 (z_i (2 A_i - A) - 2 S_i + S) by w_i and 2 w_i (2 A_i + w_i - A) by z_i. The first
// joins the gradient of the colours in the recurrence of ../compositing/backward_cpu.cpp. Depths z are relative to the first
// surfel of the tile, for accuracy.
#include "../compositing/blocks.h"
#include "surfel_blending.h"
#include "surfel_blending_math.h"

namespace GSPLAT_ISA::surfel_blending {

using compositing::kBlockHeight;
using compositing::kBlocks;
using compositing::kBlockWidth;
using compositing::kColumns;
using compositing::kPixels;
using compositing::place;
using compositing::test_blocks;
using compositing::Tile;
using gsplat::compositing::kWindow;

namespace {

constexpr float kInfinity = __builtin_inff();

GSPLAT_INLINE vint load_int(const int32_t* p) {
  vint v;
  __builtin_memcpy(&v, p, sizeof(v));
  return v;
}
GSPLAT_INLINE void store_int(int32_t* p, vint v) { __builtin_memcpy(p, &v, sizeof(v)); }

// First pixels' centres of a window's first block, and offsets of the blocks.
struct Centers {
  vfloat x, y;
  Centers(int x0, int y0) : x(compositing::lane_x() + (float(x0) + 0.5f)), y(compositing::lane_y() + (float(y0) + 0.5f)) {}
  GSPLAT_METHOD vfloat x_of(int block) const { return x + float(block % kColumns * kBlockWidth); }
  GSPLAT_METHOD vfloat y_of(int block) const { return y + float(block / kColumns * kBlockHeight); }
};

GSPLAT_INLINE const float* values_of(const Surfels& in, int32_t id, int values) { return in.values + int64_t(id) * values; }

// Depth of the tile's first surfel, which is the origin of depths.
GSPLAT_INLINE float reference_depth(const Surfels& in, const Tile& tile, int values) {
  if (tile.begin >= tile.end) return 0;
  return values_of(in, in.splats.flatten_ids[tile.begin], values)[kNormal + in.splats.channels - 1];
}

// State of a window's pixels, block by block. V numbers are blended: normal and colours.
template <int V>
struct Forward {
  alignas(64) float through[kPixels];  // transmittance after all surfels so far, including those after termination
  alignas(64) float kept[kPixels];     // transmittance after the last blended surfel
  alignas(64) float distortion[kPixels], depth_sum[kPixels], median[kPixels];
  alignas(64) int32_t last[kPixels], median_at[kPixels];
  alignas(64) float values[V][kPixels];
};

template <int V>
GSPLAT_INLINE void blend_block(const Surfels& in, const int32_t* ids, int64_t position, uint64_t surfels, float reference,
                               vfloat x, vfloat y, Forward<V>& w, int block, uint64_t& alive) {
  const int at = block * kLanes, depth_at = kNormal + in.splats.channels - 1;
  vfloat through = load(w.through + at), kept = load(w.kept + at), distortion = load(w.distortion + at);
  vfloat depth_sum = load(w.depth_sum + at), median = load(w.median + at);
  vint last = load_int(w.last + at), median_at = load_int(w.median_at + at);
  vfloat sum[V];
  for (int d = 0; d < V; ++d) sum[d] = load(w.values[d] + at);
  for (; surfels != 0; surfels &= surfels - 1) {
    const int i = __builtin_ctzll(surfels);
    const Record& record = in.records[ids[i]];
    const Hit h = hit_at(record, x, y);
    const vfloat power = power_of(record, smaller(h.plane, h.screen));
    const vmask valid = at_least(power, splat(gsplat::kLog2AlphaCutoff)) & above(larger(h.denominator, -h.denominator), vfloat{});
    const vfloat alpha = zero_unless(valid, exp2(smaller(power, splat(in.splats.alpha.log2_most))));
    const vfloat next = fma(-alpha, through, through);
    // After termination the transmittance only decreases, so this test keeps a terminated pixel closed.
    const vmask open = above(next, splat(gsplat::kMinTransmittance));
    const vfloat weight = zero_unless(open, alpha * through);
    const float* const value = values_of(in, ids[i], V);
    for (int d = 0; d < V; ++d) sum[d] = fma(weight, splat(value[d]), sum[d]);
    const vfloat depth = splat(value[depth_at] - reference);
    distortion = fma(weight + weight, fma(depth, 1.0f - through, -depth_sum), distortion);
    depth_sum = fma(weight, depth, depth_sum);
    const vmask used = vmask(open & valid);
    const vmask first_half = vmask(used & above(through, splat(0.5f)));
    median = where(first_half, splat(value[depth_at]), median);
    median_at = where(first_half, splat_int(int32_t(position + i)), median_at);
    last = where(used, splat_int(int32_t(position + i)), last);
    kept = where(open, next, kept);
    through = next;
    if (lanes_of(open) == 0) {
      alive &= ~(uint64_t(1) << block);
      break;
    }
  }
  store(w.through + at, through);
  store(w.kept + at, kept);
  store(w.distortion + at, distortion);
  store(w.depth_sum + at, depth_sum);
  store(w.median + at, median);
  store_int(w.last + at, last);
  store_int(w.median_at + at, median_at);
  for (int d = 0; d < V; ++d) store(w.values[d] + at, sum[d]);
}

template <int V>
void blend_window(const Surfels& in, const Tile& tile, int x0, int y0, const Pixels& out) {
  constexpr int kBatch = 64;  // surfels per pass over the blocks: one bit each in a block's 64-bit mask
  const int width = tile.right - x0 < kWindow ? tile.right - x0 : kWindow;
  const int height = tile.bottom - y0 < kWindow ? tile.bottom - y0 : kWindow;
  const int channels = in.splats.channels;
  Forward<V> w = {};
  uint64_t alive = 0;
  for (int i = 0; i < kPixels; ++i) w.kept[i] = 1, w.last[i] = -1, w.median_at[i] = -1;
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) w.through[place(x, y)] = 1, alive |= uint64_t(1) << (place(x, y) / kLanes);
  const Centers centers(x0, y0);
  const float reference = reference_depth(in, tile, V);
  for (int64_t first = tile.begin; first < tile.end && alive != 0; first += kBatch) {
    const int32_t* const ids = in.splats.flatten_ids + first;
    const int count = tile.end - first < kBatch ? int(tile.end - first) : kBatch;
    uint64_t surfels[kBlocks] = {};
    for (int i = 0; i < count; i += kLanes)
      test_blocks(in.bounds, ids + i, count - i, float(x0) + 0.5f, float(y0) + 0.5f,
                  [&](int block, vmask hit) { surfels[block] |= uint64_t(lanes_of(hit)) << i; });
    for (uint64_t left = alive; left != 0; left &= left - 1) {
      const int block = __builtin_ctzll(left);
      if (surfels[block] != 0)
        blend_block<V>(in, ids, first, surfels[block], reference, centers.x_of(block), centers.y_of(block), w, block, alive);
    }
  }
  const float* const background = in.splats.backgrounds != nullptr ? in.splats.backgrounds + tile.image * channels : nullptr;
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      const int at = place(x, y);
      const int64_t pixel = (tile.image * in.splats.height + y0 + y) * in.splats.width + x0 + x;
      out.alphas[pixel] = 1 - w.kept[at];
      for (int d = 0; d < kNormal; ++d) out.normals[pixel * kNormal + d] = w.values[d][at];
      for (int d = 0; d < channels; ++d)
        out.colors[pixel * channels + d] = w.values[kNormal + d][at] + (background != nullptr ? w.kept[at] * background[d] : 0);
      out.distortions[pixel] = w.distortion[at];
      out.medians[pixel] = w.median[at];
      out.depth_sums[pixel] = w.depth_sum[at];
      out.last[pixel] = w.last[at];
      out.median_at[pixel] = w.median_at[at];
    }
}

// State of a window's pixels in the backward pass, block by block.
template <int V>
struct Backward {
  alignas(64) float through[kPixels];  // transmittance in front of the surfels visited so far (from the back)
  alignas(64) float behind[kPixels];   // sum of w g of the surfels behind
  alignas(64) float alpha[kPixels];
  alignas(64) float depth_total[kPixels];  // S
  alignas(64) float depth_sum[kPixels];    // sum of w z in front of the surfels visited so far
  alignas(64) float v_distortion[kPixels], v_median[kPixels];
  alignas(64) int32_t last[kPixels], median_at[kPixels];
  alignas(64) float v_values[V][kPixels];
};

// Add the terms of one surfel at its blocks of pixels to `sum`: moments, values and absolute gradients.
template <int V, bool kAbs>
GSPLAT_INLINE void surfel_backward(const Surfels& in, int32_t id, int64_t position, uint64_t blocks, float reference,
                                   const Centers& centers, Backward<V>& w, vfloat* sum) {
  const Record& record = in.records[id];
  const float* const value = values_of(in, id, V);
  const vfloat depth = splat(value[kNormal + in.splats.channels - 1] - reference);
  vfloat* const value_sum = sum + kMoments;
  for (; blocks != 0; blocks &= blocks - 1) {
    const int block = __builtin_ctzll(blocks), at = block * kLanes;
    const Hit h = hit_at(record, centers.x_of(block), centers.y_of(block));
    const vfloat power = power_of(record, smaller(h.plane, h.screen));
    const vint here = splat_int(int32_t(position));
    const vmask valid = at_least(power, splat(gsplat::kLog2AlphaCutoff)) &
                        above(larger(h.denominator, -h.denominator), vfloat{}) & at_least(load_int(w.last + at), here);
    if (lanes_of(valid) == 0) continue;
    const vfloat alpha = zero_unless(valid, exp2(smaller(power, splat(in.splats.alpha.log2_most))));
    const vfloat widen = reciprocal(1.0f - alpha);
    const vfloat through = load(w.through + at) * widen, weight = alpha * through;
    vfloat g = {};
    for (int d = 0; d < V; ++d) {
      const vfloat v = load(w.v_values[d] + at);
      g = fma(v, splat(value[d]), g);
      value_sum[d] = fma(weight, v, value_sum[d]);
    }
    const vfloat total = load(w.alpha + at), in_front = 1.0f - through;
    const vfloat depth_sum = fma(-weight, depth, load(w.depth_sum + at)), twice = 2 * load(w.v_distortion + at);
    const vfloat balance = in_front + in_front - total;
    g = fma(twice, fma(depth, balance, load(w.depth_total + at) - 2 * depth_sum), g);
    const vint median_at = load_int(w.median_at + at);
    const vmask is_median = vmask(valid & at_least(median_at, here) & at_least(here, median_at));
    sum[kDepthMoment] = sum[kDepthMoment] + fma(twice * weight, balance + weight, zero_unless(is_median, load(w.v_median + at)));
    const vfloat behind = load(w.behind + at);
    const vfloat v_alpha = fma(through, g, -(behind * widen));
    store(w.through + at, through);
    store(w.behind + at, fma(weight, g, behind));
    store(w.depth_sum + at, depth_sum);
    // Where alpha is clamped to its maximum, opacity and shape have no gradient.
    const vmask free = vmask(valid & at_least(splat(in.splats.alpha.log2_most), power));
    const vfloat s = zero_unless(free, alpha * v_alpha);
    // The intersection is used only on the plane; elsewhere it may be infinite.
    const vmask on_plane = vmask(free & at_least(h.screen, h.plane));
    const Hit hit = {
        h.dx,    h.dy,    h.denominator, zero_unless(on_plane, h.inverse), zero_unless(on_plane, h.u), zero_unless(on_plane, h.v),
        h.plane, h.screen};
    add_moments(hit, s, zero_unless(on_plane, s), sum);
    if constexpr (kAbs) {
      const vfloat on_screen = kScreenFactor * (s - zero_unless(on_plane, s));
      const vfloat by_x = on_screen * h.dx, by_y = on_screen * h.dy;
      value_sum[V] = value_sum[V] + larger(by_x, -by_x);
      value_sum[V + 1] = value_sum[V + 1] + larger(by_y, -by_y);
    }
  }
}

template <int V, bool kAbs>
void window_backward(const Surfels& in, const Tile& tile, int x0, int y0, int64_t tile_index, bool add,
                     const PixelGradients& from, const GradientRows& out) {
  constexpr int kValues = kMoments + V + (kAbs ? 2 : 0);
  const int width = tile.right - x0 < kWindow ? tile.right - x0 : kWindow;
  const int height = tile.bottom - y0 < kWindow ? tile.bottom - y0 : kWindow;
  const int channels = in.splats.channels;
  const float* const background = in.splats.backgrounds != nullptr ? in.splats.backgrounds + tile.image * channels : nullptr;
  Backward<V> w = {};
  int32_t block_last[kBlocks], furthest = -1;
  for (int i = 0; i < kPixels; ++i) w.through[i] = 1, w.last[i] = -1, w.median_at[i] = -1;
  for (int block = 0; block < kBlocks; ++block) block_last[block] = -1;
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      const int at = place(x, y);
      const int64_t pixel = (tile.image * in.splats.height + y0 + y) * in.splats.width + x0 + x;
      const float left = 1 - from.alphas[pixel];
      float v_left = -from.v_alphas[pixel];
      for (int d = 0; d < kNormal; ++d) w.v_values[d][at] = from.v_normals[pixel * kNormal + d];
      for (int d = 0; d < channels; ++d) {
        const float v = from.v_colors[pixel * channels + d];
        w.v_values[kNormal + d][at] = v;
        if (background == nullptr) continue;
        v_left += v * background[d];
        out.v_backgrounds[tile_index * channels + d] += v * left;
      }
      w.through[at] = left;
      w.behind[at] = left * v_left;
      w.alpha[at] = from.alphas[pixel];
      w.depth_total[at] = w.depth_sum[at] = from.depth_sums[pixel];
      w.v_distortion[at] = from.v_distortions[pixel];
      w.v_median[at] = from.v_medians[pixel];
      w.last[at] = from.last[pixel];
      w.median_at[at] = from.median_at[pixel];
      int32_t& most = block_last[at / kLanes];
      most = w.last[at] > most ? w.last[at] : most;
      furthest = most > furthest ? most : furthest;
    }
  const Centers centers(x0, y0);
  const float reference = reference_depth(in, tile, V);
  for (int64_t first = tile.begin + (tile.end - tile.begin - 1) / kLanes * kLanes; first >= tile.begin && first < tile.end;
       first -= kLanes) {
    const int count = tile.end - first < kLanes ? int(tile.end - first) : kLanes;
    uint64_t touched[kLanes] = {};
    if (first <= furthest)
      test_blocks(in.bounds, in.splats.flatten_ids + first, count, float(x0) + 0.5f, float(y0) + 0.5f, [&](int block, vmask hit) {
        for (uint32_t lanes = lanes_of(hit); lanes != 0; lanes &= lanes - 1) {
          const int i = __builtin_ctz(lanes);
          if (block_last[block] >= first + i) touched[i] |= uint64_t(1) << block;
        }
      });
    for (int i = count - 1; i >= 0; --i) {
      float* const to = out.rows + int64_t(out.row_of[first + i]) * out.row_size;
      if (touched[i] == 0) {
        if (!add)
          for (int r = 0; r < kValues; ++r) to[r] = 0;
        continue;
      }
      vfloat sum[kValues] = {};
      surfel_backward<V, kAbs>(in, in.splats.flatten_ids[first + i], first + i, touched[i], reference, centers, w, sum);
      float row[kValues];
      sums<kValues>(sum, row);
      for (int r = 0; r < kValues; ++r) to[r] = add ? to[r] + row[r] : row[r];
    }
  }
}

template <int V, bool kAbs>
void blend_tile_backward(const Surfels& in, const Tile& tile, int64_t index, const PixelGradients& from,
                         const GradientRows& out) {
  bool add = false;
  for (int y = tile.y; y < tile.bottom; y += kWindow)
    for (int x = tile.x; x < tile.right; x += kWindow, add = true)
      window_backward<V, kAbs>(in, tile, x, y, index, add, from, out);
  if (!add) {  // tile outside of the image: its instances reach no pixel
    for (int64_t position = tile.begin; position < tile.end; ++position)
      for (int64_t r = 0; r < out.row_size; ++r) out.rows[out.row_of[position] * out.row_size + r] = 0;
  }
}

// Call run with the number of values of a surfel: normal and padded colours.
template <class Run>
GSPLAT_INLINE void with_values(int channels, const Run& run) {
  switch (padded_channels(channels)) {
    case 1: return run.template operator()<kNormal + 1>();
    case 3: return run.template operator()<kNormal + 3>();
    case 4: return run.template operator()<kNormal + 4>();
    case 8: return run.template operator()<kNormal + 8>();
    default: return run.template operator()<kNormal + kMaxChannels>();
  }
}

Tile tile_of(const Surfels& in, int64_t index) {
  compositing::Splats splats;
  static_cast<compositing::Inputs&>(splats) = in.splats;
  splats.records = nullptr;
  return compositing::tile_of(splats, index);
}

}  // namespace

void make_records(const Inputs& in, int64_t begin, int64_t end, Record* records, compositing::SplatRecord* bounds,
                  float* values) {
  const int channels = in.splats.channels, row = kNormal + padded_channels(channels);
  for (int64_t i = begin; i < end; ++i) {
    const float *mean = in.splats.means2d + 2 * i, *transform = in.transforms + 9 * i, *color = in.splats.colors + channels * i;
    const float *normal = in.normals + kNormal * i, opacity = in.splats.opacities[i];
    float check = 0 * mean[0] + 0 * mean[1] + 0 * opacity;  // NaN if any number is not finite
    for (int k = 0; k < 9; ++k) check += 0 * transform[k];
    for (int k = 0; k < kNormal; ++k) check += 0 * normal[k];
    for (int d = 0; d < channels; ++d) check += 0 * color[d];
    const bool usable = check == 0;
    const Plane plane = plane_of(mean, transform);
    records[i] = record_of(mean, plane, opacity, usable);
    const bool visible = records[i].l > -kInfinity;
    const Bound b = visible ? bound_of(mean, plane, opacity) : Bound{};
    bounds[i] = {
        b.x, b.y, -kHalfLog2E * b.conic[0], -2 * kHalfLog2E * b.conic[1], -kHalfLog2E * b.conic[2], records[i].l, kInfinity,
        0,   {}};
    float* const to = values + row * i;
    for (int k = 0; k < kNormal; ++k) to[k] = usable ? normal[k] : 0;
    for (int d = 0; d < row - kNormal; ++d) to[kNormal + d] = usable && d < channels ? color[d] : 0;
  }
}

void tile(const Surfels& in, int64_t index, const Pixels& out) {
  Tile t = tile_of(in, index);
  if (t.masked) t.end = t.begin;  // a masked tile shows only the background
  with_values(in.splats.channels, [&]<int V>() {
    for (int y = t.y; y < t.bottom; y += kWindow)
      for (int x = t.x; x < t.right; x += kWindow) blend_window<V>(in, t, x, y, out);
  });
}

void tile_backward(const Surfels& in, int64_t index, const PixelGradients& from, const GradientRows& out) {
  const Tile t = tile_of(in, index);
  with_values(in.splats.channels, [&]<int V>() {
    if (out.absgrad)
      blend_tile_backward<V, true>(in, t, index, from, out);
    else
      blend_tile_backward<V, false>(in, t, index, from, out);
  });
}

void gather(const Surfels& in, const GradientRows& from, const int32_t* first, int64_t begin, int64_t end,
            const InputGradients& out) {
  const int channels = in.splats.channels, values = kNormal + padded_channels(channels);
  const int row_values = kMoments + values + (from.absgrad ? 2 : 0);
  for (int64_t i = begin; i < end; ++i) {
    const bool usable = in.records[i].l > -kInfinity;
    float total[kMoments + kNormal + kMaxChannels + 2] = {};
    for (int64_t row = first[i]; usable && row < first[i + 1]; ++row)
      for (int r = 0; r < row_values; ++r) total[r] += from.rows[row * from.row_size + r];
    if (usable) {
      surfel_gradients(total, in.splats.means2d + 2 * i, in.transforms + 9 * i, in.splats.opacities[i], out.means2d + 2 * i,
                       out.transforms + 9 * i, out.opacities + i, out.densify + 2 * i);
    } else {
      for (int k = 0; k < 2; ++k) out.means2d[2 * i + k] = out.densify[2 * i + k] = 0;
      for (int k = 0; k < 9; ++k) out.transforms[9 * i + k] = 0;
      out.opacities[i] = 0;
    }
    const float* const value = total + kMoments;
    for (int k = 0; k < kNormal; ++k) out.normals[kNormal * i + k] = value[k];
    for (int d = 0; d < channels; ++d) out.colors[channels * i + d] = value[kNormal + d];
    out.colors[channels * (i + 1) - 1] += total[kDepthMoment];
    for (int r = 0; from.absgrad && r < 2; ++r) out.absolute[2 * i + r] = value[values + r];
  }
}

extern const gsplat::surfel_blending::Kernels kernels = {make_records, tile, tile_backward, gather};

}  // namespace GSPLAT_ISA::surfel_blending
