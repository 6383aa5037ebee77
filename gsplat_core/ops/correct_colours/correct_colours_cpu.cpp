// The weights are those of the compositing kernels: the same blocks, alpha, cut-off and termination.
#include "correct_colours.h"

#include "../compositing/blocks.h"

namespace GSPLAT_ISA::correct_colours {

using namespace gsplat::correct_colours;
using namespace GSPLAT_ISA::compositing;

namespace {

constexpr int kBatch = 64;  // splats per pass over the blocks: one bit each in a block's 64-bit mask

static_assert(kBlocks <= 1 << kBlockBits && kSums * kPixels == kTargetFloats && kLanes <= kMostLanes);

GSPLAT_INLINE int block_of(int32_t code) { return code & ((1 << kBlockBits) - 1); }

// Call run(first, ids, bit sets of the splats in each block) for batches of the tile's splats while it returns true.
template <class Run>
GSPLAT_INLINE void for_batches(const Splats& in, const Tile& tile, const Run& run) {
  for (int64_t first = tile.begin; first < tile.end; first += kBatch) {
    const int32_t* const ids = in.flatten_ids + first;
    const int count = tile.end - first < kBatch ? int(tile.end - first) : kBatch;
    uint64_t splats[kBlocks] = {};
    for (int i = 0; i < count; i += kLanes)
      test_blocks(in.records, ids + i, count - i, float(tile.x) + 0.5f, float(tile.y) + 0.5f,
                  [&](int block, vmask hit) { splats[block] |= uint64_t(lanes_of(hit)) << i; });
    if (!run(first, ids, splats)) return;
  }
}

int64_t most_pairs(const Splats& in, int64_t index) {
  int64_t pairs = 0;
  for_batches(in, tile_of(in, index), [&](int64_t, const int32_t*, const uint64_t* splats) {
    for (int block = 0; block < kBlocks; ++block) pairs += __builtin_popcountll(splats[block]);
    return true;
  });
  return pairs;
}

// Sort the pairs by splat, stably.
void sort_pairs(int64_t splats, const TileWeights& out, int64_t pairs) {
  for (int64_t i = 0; i <= splats; ++i) out.first[i] = 0;
  for (int64_t i = 0; i < pairs; ++i) ++out.first[out.codes[i] >> kBlockBits];
  int32_t end = 0;
  for (int64_t i = 0; i <= splats; ++i) out.first[i] = end += out.first[i];
  for (int64_t i = pairs - 1; i >= 0; --i) out.order[--out.first[out.codes[i] >> kBlockBits]] = int32_t(i);
}

int64_t weigh(const Splats& in, int64_t index, const Picture& picture, const TileWeights& out) {
  const Tile tile = tile_of(in, index);
  alignas(64) float through[kPixels] = {};
  uint64_t alive = 0;
  for (int i = 0; i < kTargetFloats; ++i) out.target[i] = 0;
  for (int y = 0; y < tile.bottom - tile.y; ++y)
    for (int x = 0; x < tile.right - tile.x; ++x) {
      const int64_t pixel = int64_t(tile.y + y) * in.width + tile.x + x;
      const int at = place(x, y);
      through[at] = 1;
      alive |= uint64_t(1) << (at / kLanes);
      if (picture.mask[pixel] == 0) continue;
      for (int d = 0; d < 3; ++d) out.target[d * kPixels + at] = float(picture.image[3 * pixel + d]) * (1.0f / 255);
      out.target[3 * kPixels + at] = 1;
    }
  const vfloat left = lane_x() + (float(tile.x) + 0.5f), top = lane_y() + (float(tile.y) + 0.5f);
  int64_t pairs = 0;
  for_batches(in, tile, [&](int64_t first, const int32_t* ids, const uint64_t* splats) {
    for (uint64_t blocks = alive; blocks != 0; blocks &= blocks - 1) {
      const int block = __builtin_ctzll(blocks);
      const vfloat x = left + float(block % kColumns * kBlockWidth), y = top + float(block / kColumns * kBlockHeight);
      vfloat open_through = load(through + block * kLanes);
      for (uint64_t bits = splats[block]; bits != 0; bits &= bits - 1) {
        const int i = __builtin_ctzll(bits);
        const SplatRecord& record = in.records[ids[i]];
        const vfloat power = falloff(record, x, y).power;
        const vmask valid = at_least(power, splat(kLog2AlphaCutoff)) & at_least(splat(record.cap), power);
        const vfloat alpha = zero_unless(valid, exp2(smaller(power, splat(in.alpha.log2_most))));
        const vfloat next = fma(-alpha, open_through, open_through);
        const vmask open = above(next, splat(kMinTransmittance));
        const vmask counted = open & valid;
        if (lanes_of(counted) != 0) {
          store(out.values + pairs * kLanes, zero_unless(counted, alpha * open_through));
          out.codes[pairs++] = int32_t(first - tile.begin + i) << kBlockBits | block;
        }
        open_through = next;
        if (lanes_of(open) == 0) {
          alive &= ~(uint64_t(1) << block);
          break;
        }
      }
      store(through + block * kLanes, open_through);
    }
    return alive != 0;
  });
  sort_pairs(tile.end - tile.begin, out, pairs);
  return pairs;
}

template <int D>
void sums_of_splats(const Tile& tile, const TileWeights& weights, const float* channels, const int32_t* row_of, float* rows) {
  for (int64_t i = 0; i < tile.end - tile.begin; ++i) {
    vfloat sum[D] = {};
    for (int64_t at = weights.first[i]; at < weights.first[i + 1]; ++at) {
      const int32_t pair = weights.order[at];
      const float* const values = channels + block_of(weights.codes[pair]) * kLanes;
      const vfloat weight = load(weights.values + int64_t(pair) * kLanes);
      for (int d = 0; d < D; ++d) sum[d] = fma(weight, load(values + d * kPixels), sum[d]);
    }
    sums<D>(sum, rows + int64_t(row_of[tile.begin + i]) * kSums);
  }
}

void tile_sums(const Splats& in, int64_t index, const TileWeights& weights, const float* shown, bool weighs,
               const int32_t* row_of, float* rows) {
  const Tile tile = tile_of(in, index);
  const int32_t* const ids = in.flatten_ids + tile.begin;
  alignas(64) float channels[kTargetFloats] = {};  // the picture, then the residual; the last one is the mask
  for (int64_t pair = 0; pair < weights.pairs;) {
    const int block = block_of(weights.codes[pair]);
    float* const to = channels + block * kLanes;
    vfloat red = load(to), green = load(to + kPixels), blue = load(to + 2 * kPixels);
    do {
      const float* const color = shown + int64_t(kSums) * ids[weights.codes[pair] >> kBlockBits];
      const vfloat weight = load(weights.values + pair * kLanes);
      red = fma(weight, splat(color[0]), red);
      green = fma(weight, splat(color[1]), green);
      blue = fma(weight, splat(color[2]), blue);
    } while (++pair < weights.pairs && block_of(weights.codes[pair]) == block);
    store(to, red);
    store(to + kPixels, green);
    store(to + 2 * kPixels, blue);
  }
  for (int at = 0; at < kPixels; at += kLanes) {
    const vfloat mask = load(weights.target + 3 * kPixels + at);
    for (int d = 0; d < 3; ++d) {
      float* const to = channels + d * kPixels + at;
      store(to, fma(-mask, load(to), load(weights.target + d * kPixels + at)));
    }
    store(channels + 3 * kPixels + at, mask);
  }
  if (weighs)
    sums_of_splats<kSums>(tile, weights, channels, row_of, rows);
  else
    sums_of_splats<3>(tile, weights, channels, row_of, rows);
}

}  // namespace

extern const gsplat::correct_colours::Kernels kernels = {kLanes, make_records, most_pairs, weigh, tile_sums};

}  // namespace GSPLAT_ISA::correct_colours
