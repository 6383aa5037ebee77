// Front-to-back blending of ray depths and channels, and its gradient traversed back to front. Weights and gradients of
// the splats' shapes are those of ../compositing; the comments there describe the method.
#include "../compositing/blocks.h"
#include "ray_blending_math.h"

namespace GSPLAT_ISA::ray_blending {

namespace {

using compositing::falloff;
using compositing::Falloff;
using compositing::kBlockHeight;
using compositing::kBlocks;
using compositing::kBlockWidth;
using compositing::kColumns;
using compositing::kPixels;
using compositing::kWindow;
using compositing::place;
using compositing::SplatRecord;
using compositing::test_blocks;
using compositing::Tile;

constexpr float kInfinity = __builtin_inff();

// Copy the channels of splat `id` to `values`; further values are 0.
template <int D>
GSPLAT_INLINE void padded_values(const Inputs& in, int32_t id, float (&values)[D > 0 ? D : 1]) {
  for (int d = 0; d < D; ++d) values[d] = d < in.channels ? in.values[int64_t(id) * in.channels + d] : 0;
}

// State of a tile's pixels during blending, in blocks of kLanes pixels. D: at least the number of blended values.
template <int D>
struct Forward {
  alignas(64) float through[kPixels];  // transmittance after all splats so far, including those after termination
  alignas(64) float kept[kPixels];     // transmittance after the last blended splat
  alignas(64) int32_t last[kPixels], median_at[kPixels];
  alignas(64) float first[kPixels];  // depth of the first blended splat; the sums are relative to it
  alignas(64) float offset[kPixels], square[kPixels], median[kPixels];
  alignas(64) float values[D > 0 ? D : 1][kPixels];
};

template <int D>
void blend_block(const Inputs& in, const SplatRecord* records, const int32_t* ids, int64_t position, uint64_t splats, vfloat x,
                 vfloat y, Forward<D>& w, int block, uint64_t& alive) {
  const int at = block * kLanes;
  vfloat through = load(w.through + at), kept = load(w.kept + at), first = load(w.first + at);
  vfloat offset_sum = load(w.offset + at), square_sum = load(w.square + at), median = load(w.median + at);
  vint last, median_at;
  __builtin_memcpy(&last, w.last + at, sizeof(last));
  __builtin_memcpy(&median_at, w.median_at + at, sizeof(median_at));
  for (; splats != 0; splats &= splats - 1) {
    const int i = __builtin_ctzll(splats);
    const SplatRecord& record = records[ids[i]];
    const float* const ray = in.rays + int64_t(ids[i]) * kRayNumbers;
    const Falloff f = falloff(record, x, y);
    const vmask valid = at_least(f.power, splat(gsplat::kLog2AlphaCutoff)) & at_least(splat(record.cap), f.power);
    const vfloat alpha = zero_unless(valid, exp2(smaller(f.power, splat(in.splats.alpha.log2_most))));
    const vfloat next = fma(-alpha, through, through);
    const vmask open = above(next, splat(gsplat::kMinTransmittance));
    const vfloat weight = zero_unless(open, alpha * through);
    const Fraction fraction = fraction_at(ray, f.dx, f.dy);
    const vfloat widen = 1.0f / fraction.denominator;
    const vfloat depth = smaller(larger(fraction.numerator * widen, splat(ray[kZ] - ray[kReach])), splat(ray[kZ] + ray[kReach]));
    const vmask blended = open & valid;
    first = where(vmask(blended & ~at_least(last, vint{})), depth, first);
    const vfloat offset = depth - first, weighted = weight * offset;
    offset_sum = offset_sum + weighted;
    square_sum = fma(weighted, offset, fma(weight, widen * ray[kVariance], square_sum));
    const vmask half = vmask(blended & above(through, splat(0.5f)) & ~above(next, splat(0.5f)));
    median = where(half, depth, median);
    median_at = where(half, splat_int(int32_t(position + i)), median_at);
    if constexpr (D > 0) {
      const float* const values = in.values + int64_t(ids[i]) * in.channels;
      for (int d = 0; d < D; ++d) {
        if (d >= in.channels) break;
        store(w.values[d] + at, fma(weight, splat(values[d]), load(w.values[d] + at)));
      }
    }
    last = where(blended, splat_int(int32_t(position + i)), last);
    kept = where(open, next, kept);
    through = next;
    if (lanes_of(open) == 0) {
      alive &= ~(uint64_t(1) << block);
      break;
    }
  }
  store(w.through + at, through), store(w.kept + at, kept), store(w.first + at, first);
  store(w.offset + at, offset_sum), store(w.square + at, square_sum), store(w.median + at, median);
  __builtin_memcpy(w.last + at, &last, sizeof(last));
  __builtin_memcpy(w.median_at + at, &median_at, sizeof(median_at));
}

template <int D>
void blend_tile(const Inputs& in, const SplatRecord* records, const Tile& tile, const Pixels& out) {
  constexpr int kBatch = 64;  // splats per pass over the blocks: one bit each in a block's 64-bit mask
  const int width = tile.right - tile.x, height = tile.bottom - tile.y;
  Forward<D> w = {};
  uint64_t alive = 0;
  for (int i = 0; i < kPixels; ++i) w.kept[i] = 1, w.last[i] = -1, w.median_at[i] = -1;
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) w.through[place(x, y)] = 1, alive |= uint64_t(1) << (place(x, y) / kLanes);
  const vfloat block_x = compositing::lane_x() + (float(tile.x) + 0.5f), block_y = compositing::lane_y() + (float(tile.y) + 0.5f);
  for (int64_t first = tile.begin; first < tile.end && alive != 0; first += kBatch) {
    const int32_t* const ids = in.splats.flatten_ids + first;
    const int count = tile.end - first < kBatch ? int(tile.end - first) : kBatch;
    uint64_t splats[kBlocks] = {};
    for (int i = 0; i < count; i += kLanes)
      test_blocks(records, ids + i, count - i, float(tile.x) + 0.5f, float(tile.y) + 0.5f,
                  [&](int block, vmask hit) { splats[block] |= uint64_t(lanes_of(hit)) << i; });
    for (uint64_t left = alive; left != 0; left &= left - 1) {
      const int block = __builtin_ctzll(left);
      if (splats[block] == 0) continue;
      blend_block<D>(in, records, ids, first, splats[block], block_x + float(block % kColumns * kBlockWidth),
                     block_y + float(block / kColumns * kBlockHeight), w, block, alive);
    }
  }
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      const int at = place(x, y);
      const int64_t pixel = int64_t(tile.y + y) * in.splats.width + tile.x + x;
      const float alpha = 1 - w.kept[at], mean = alpha > 0 ? w.offset[at] / alpha : 0;
      const float variance = alpha > 0 ? w.square[at] / alpha - mean * mean : 0;
      out.alphas[pixel] = alpha;
      out.depths[pixel] = w.first[at] + mean;
      out.medians[pixel] = w.median[at];
      out.variances[pixel] = variance > 0 ? variance : 0;
      out.last[pixel] = w.last[at];
      out.median_at[pixel] = w.median_at[at];
      for (int d = 0; d < in.channels; ++d) out.values[pixel * in.channels + d] = w.values[d][at];
    }
}

// State of a tile's pixels in the backward pass, block by block.
template <int D>
struct Backward {
  alignas(64) float through[kPixels];  // transmittance in front of the splats visited so far (from the back)
  alignas(64) float behind[kPixels];   // sum of w g of the splats behind
  alignas(64) int32_t last[kPixels], median_at[kPixels];
  alignas(64) float depth[kPixels];
  alignas(64) float v_mean[kPixels];  // dL/d(mean depth) / alpha
  alignas(64) float v_median[kPixels];
  alignas(64) float v_values[D > 0 ? D : 1][kPixels];
};

// Add one splat's gradient terms at the pixels of `blocks` (one bit each) to `sum`: shape, ray, then values.
template <int D>
GSPLAT_INLINE void splat_backward(const Inputs& in, const SplatRecord* records, int32_t id, int64_t position, uint64_t blocks,
                                  vfloat block_x, vfloat block_y, Backward<D>& w, vfloat* sum) {
  const SplatRecord& record = records[id];
  const float* const ray = in.rays + int64_t(id) * kRayNumbers;
  float values[D > 0 ? D : 1];
  padded_values<D>(in, id, values);
  vfloat* const ray_sum = sum + kMoments;
  vfloat* const value_sum = ray_sum + kRaySums;
  for (; blocks != 0; blocks &= blocks - 1) {
    const int block = __builtin_ctzll(blocks), at = block * kLanes;
    const Falloff f =
        falloff(record, block_x + float(block % kColumns * kBlockWidth), block_y + float(block / kColumns * kBlockHeight));
    vint last, median_at;
    __builtin_memcpy(&last, w.last + at, sizeof(last));
    __builtin_memcpy(&median_at, w.median_at + at, sizeof(median_at));
    const vint here = splat_int(int32_t(position));
    const vmask valid =
        at_least(f.power, splat(gsplat::kLog2AlphaCutoff)) & at_least(splat(record.cap), f.power) & at_least(last, here);
    const vfloat alpha = zero_unless(valid, exp2(smaller(f.power, splat(in.splats.alpha.log2_most))));
    const vfloat widen = reciprocal(1.0f - alpha);
    const vfloat through = load(w.through + at) * widen, weight = alpha * through;

    const Fraction fraction = fraction_at(ray, f.dx, f.dy);
    const vfloat inverse = 1.0f / fraction.denominator, free = fraction.numerator * inverse;
    const vfloat low = splat(ray[kZ] - ray[kReach]), high = splat(ray[kZ] + ray[kReach]);
    const vfloat depth = smaller(larger(free, low), high), v_mean = load(w.v_mean + at);
    const vmask is_median = valid & at_least(median_at, here) & at_least(here, median_at);
    const vfloat v_depth = fma(weight, v_mean, zero_unless(is_median, load(w.v_median + at)));
    const vmask within = at_least(free, low) & at_least(high, free);
    const vfloat a = zero_unless(within, v_depth * inverse), b = -a * depth;
    const vfloat limited = v_depth - zero_unless(within, v_depth);
    const vfloat bx = b * f.dx, by = b * f.dy;
    ray_sum[0] = ray_sum[0] + a;
    ray_sum[1] = fma(a, f.dx, ray_sum[1]);
    ray_sum[2] = fma(a, f.dy, ray_sum[2]);
    ray_sum[3] = ray_sum[3] + b;
    ray_sum[4] = ray_sum[4] + bx;
    ray_sum[5] = ray_sum[5] + by;
    ray_sum[6] = fma(bx, f.dx, ray_sum[6]);
    ray_sum[7] = fma(bx, f.dy, ray_sum[7]);
    ray_sum[8] = fma(by, f.dy, ray_sum[8]);
    ray_sum[9] = ray_sum[9] + limited;
    ray_sum[10] = ray_sum[10] + where(above(free, high), limited, -limited);

    vfloat g = v_mean * (depth - load(w.depth + at));
    if constexpr (D > 0) {
      for (int d = 0; d < D; ++d) {
        const vfloat v = load(w.v_values[d] + at);
        g = fma(v, splat(values[d]), g);
        value_sum[d] = fma(weight, v, value_sum[d]);
      }
    }
    const vfloat behind = load(w.behind + at);
    const vfloat v_alpha = fma(through, g, -(behind * widen));
    store(w.through + at, through);
    store(w.behind + at, fma(weight, g, behind));
    // Where alpha is clamped to its maximum, opacity and shape have no gradient.
    const vfloat s = zero_unless(valid & at_least(splat(in.splats.alpha.log2_most), f.power), alpha * v_alpha);
    const vfloat sx = s * f.dx, sy = s * f.dy;
    sum[0] = sum[0] + s;
    sum[1] = sum[1] + sx;
    sum[2] = sum[2] + sy;
    sum[3] = fma(sx, f.dx, sum[3]);
    sum[4] = fma(sx, f.dy, sum[4]);
    sum[5] = fma(sy, f.dy, sum[5]);
  }
}

template <int D>
void blend_tile_backward(const Inputs& in, const SplatRecord* records, const Tile& tile, const PixelGradients& from,
                         const GradientRows& out) {
  constexpr int kValues = kMoments + kRaySums + D;
  const int width = tile.right - tile.x, height = tile.bottom - tile.y;
  Backward<D> w = {};
  for (int i = 0; i < kPixels; ++i) w.through[i] = 1, w.last[i] = -1, w.median_at[i] = -1;
  int32_t block_last[kBlocks], furthest = -1;
  for (int block = 0; block < kBlocks; ++block) block_last[block] = -1;
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      const int at = place(x, y);
      const int64_t pixel = int64_t(tile.y + y) * in.splats.width + tile.x + x;
      const float alpha = from.alphas[pixel], left = 1 - alpha;
      const int32_t last = from.last[pixel];
      w.through[at] = left;
      w.behind[at] = -left * from.v_alphas[pixel];
      w.last[at] = last;
      w.median_at[at] = from.median_at[pixel];
      w.depth[at] = from.depths[pixel];
      w.v_mean[at] = alpha > 0 ? from.v_depths[pixel] / alpha : 0;
      w.v_median[at] = from.v_medians[pixel];
      for (int d = 0; d < in.channels; ++d) w.v_values[d][at] = from.v_values[pixel * in.channels + d];
      int32_t& most = block_last[at / kLanes];
      most = last > most ? last : most;
      furthest = last > furthest ? last : furthest;
    }
  const vfloat block_x = compositing::lane_x() + (float(tile.x) + 0.5f), block_y = compositing::lane_y() + (float(tile.y) + 0.5f);
  for (int64_t first = tile.begin + (tile.end - tile.begin - 1) / kLanes * kLanes; first >= tile.begin && first < tile.end;
       first -= kLanes) {
    const int count = tile.end - first < kLanes ? int(tile.end - first) : kLanes;
    uint64_t touched[kLanes] = {};
    if (first <= furthest)
      test_blocks(records, in.splats.flatten_ids + first, count, float(tile.x) + 0.5f, float(tile.y) + 0.5f,
                  [&](int block, vmask hit) {
                    for (uint32_t lanes = lanes_of(hit); lanes != 0; lanes &= lanes - 1) {
                      const int i = __builtin_ctz(lanes);
                      if (block_last[block] >= first + i) touched[i] |= uint64_t(1) << block;
                    }
                  });
    for (int i = count - 1; i >= 0; --i) {
      const int64_t position = first + i;
      float* const to = out.rows + int64_t(out.row_of[position]) * out.row_size;
      if (touched[i] == 0) {
        for (int r = 0; r < out.row_size; ++r) to[r] = 0;
        continue;
      }
      vfloat sum[kValues] = {};
      splat_backward<D>(in, records, in.splats.flatten_ids[position], position, touched[i], block_x, block_y, w, sum);
      sums<kValues>(sum, to);
    }
  }
}

// Call run with the smallest compiled number of channels that is sufficient.
template <class Run>
GSPLAT_INLINE void with_channels(int channels, const Run& run) {
  if (channels == 0) return run.template operator()<0>();
  if (channels <= 3) return run.template operator()<3>();
  if (channels <= 8) return run.template operator()<8>();
  return run.template operator()<kMaxChannels>();
}

compositing::Splats with_records(const Inputs& in, const SplatRecord* records) {
  compositing::Splats splats;
  static_cast<compositing::Inputs&>(splats) = in.splats;
  splats.records = records;
  return splats;
}

}  // namespace

void make_records(const Inputs& in, int64_t begin, int64_t end, SplatRecord* records) {
  compositing::make_records(in.splats, begin, end, records);
  for (int64_t i = begin; i < end; ++i) {
    float check = 0;  // NaN if any value is not finite
    for (int r = 0; r < kRayNumbers; ++r) check += 0 * in.rays[i * kRayNumbers + r];
    for (int d = 0; d < in.channels; ++d) check += 0 * in.values[i * in.channels + d];
    if (!(check == 0)) records[i].l = -kInfinity;
  }
}

void tile(const Inputs& in, const SplatRecord* records, int64_t index, const Pixels& out) {
  const Tile t = compositing::tile_of(with_records(in, records), index);
  with_channels(in.channels, [&]<int D>() { blend_tile<D>(in, records, t, out); });
}

void tile_backward(const Inputs& in, const SplatRecord* records, int64_t index, const PixelGradients& from,
                   const GradientRows& out) {
  const Tile t = compositing::tile_of(with_records(in, records), index);
  with_channels(in.channels, [&]<int D>() { blend_tile_backward<D>(in, records, t, from, out); });
}

void gather(const Inputs& in, const SplatRecord* records, const GradientRows& from, const int32_t* first, int64_t begin,
            int64_t end, const InputGradients& out) {
  for (int64_t i = begin; i < end; ++i) {
    const bool usable = records[i].l > -kInfinity;
    const int values = kMoments + kRaySums + in.channels;
    float total[kMoments + kRaySums + kMaxChannels] = {};
    for (int64_t row = first[i]; usable && row < first[i + 1]; ++row)
      for (int r = 0; r < values; ++r) total[r] += from.rows[row * from.row_size + r];
    constexpr float kNone[kRayNumbers] = {};
    splat_gradients(total, usable ? in.splats.conics + 3 * i : kNone, usable ? in.rays + kRayNumbers * i : kNone,
                    usable ? in.splats.opacities[i] : 1, out.means2d + 2 * i, out.conics + 3 * i, out.opacities + i,
                    out.rays + kRayNumbers * i);
    for (int d = 0; d < in.channels; ++d) out.values[i * in.channels + d] = total[kMoments + kRaySums + d];
  }
}

// Raise *to to a positive value. Positive floats order as integers, and the maximum does not depend on the order of threads.
GSPLAT_INLINE void raise(float* to, float value) {
  int32_t wanted, seen;
  __builtin_memcpy(&wanted, &value, sizeof(wanted));
  int32_t* const at = reinterpret_cast<int32_t*>(to);
  seen = __atomic_load_n(at, __ATOMIC_RELAXED);
  while (seen < wanted && !__atomic_compare_exchange_n(at, &seen, wanted, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
  }
}

void contributions(const compositing::Splats& splats, int64_t index, float* most) {
  constexpr int kBatch = 64;  // splats per pass over the blocks: one bit each in a block's 64-bit mask
  const Tile tile = compositing::tile_of(splats, index);
  alignas(64) float through[kPixels] = {};
  uint64_t alive = 0;
  for (int y = 0; y < tile.bottom - tile.y; ++y)
    for (int x = 0; x < tile.right - tile.x; ++x) through[place(x, y)] = 1, alive |= uint64_t(1) << (place(x, y) / kLanes);
  const vfloat block_x = compositing::lane_x() + (float(tile.x) + 0.5f), block_y = compositing::lane_y() + (float(tile.y) + 0.5f);
  for (int64_t first = tile.begin; first < tile.end && alive != 0; first += kBatch) {
    const int32_t* const ids = splats.flatten_ids + first;
    const int count = tile.end - first < kBatch ? int(tile.end - first) : kBatch;
    uint64_t touched[kBlocks] = {};
    for (int i = 0; i < count; i += kLanes)
      test_blocks(splats.records, ids + i, count - i, float(tile.x) + 0.5f, float(tile.y) + 0.5f,
                  [&](int block, vmask hit) { touched[block] |= uint64_t(lanes_of(hit)) << i; });
    for (uint64_t left = alive; left != 0; left &= left - 1) {
      const int block = __builtin_ctzll(left), at = block * kLanes;
      const vfloat x = block_x + float(block % kColumns * kBlockWidth), y = block_y + float(block / kColumns * kBlockHeight);
      vfloat in_front = load(through + at);
      for (uint64_t left_splats = touched[block]; left_splats != 0; left_splats &= left_splats - 1) {
        const int32_t id = ids[__builtin_ctzll(left_splats)];
        const SplatRecord& record = splats.records[id];
        const vfloat power = falloff(record, x, y).power;
        const vmask valid = at_least(power, splat(gsplat::kLog2AlphaCutoff)) & at_least(splat(record.cap), power);
        const vfloat alpha = zero_unless(valid, exp2(smaller(power, splat(splats.alpha.log2_most))));
        const vfloat next = fma(-alpha, in_front, in_front);
        const vmask open = above(next, splat(gsplat::kMinTransmittance));
        const vfloat weight = zero_unless(open, alpha * in_front);
        float largest = 0;
        for (int lane = 0; lane < kLanes; ++lane) largest = weight[lane] > largest ? weight[lane] : largest;
        if (largest > 0) raise(most + id, largest);
        in_front = next;
        if (lanes_of(open) == 0) {
          alive &= ~(uint64_t(1) << block);
          break;
        }
      }
      store(through + at, in_front);
    }
  }
}

extern const Kernels kernels = {make_records, tile, tile_backward, gather, contributions};

}  // namespace GSPLAT_ISA::ray_blending
