// Blending of flow over the windows and blocks of compositing. Both passes visit a tile's splats front to back.
#include "../compositing/blocks.h"
#include "flow_blending_math.h"

namespace GSPLAT_ISA::flow_blending {

namespace {

using compositing::falloff;
using compositing::kBlockHeight;
using compositing::kBlocks;
using compositing::kBlockWidth;
using compositing::kColumns;
using compositing::kPixels;
using compositing::lane_x;
using compositing::lane_y;
using compositing::place;
using compositing::prefetch_records;
using compositing::test_blocks;
using compositing::Tile;
using compositing::tile_of;
using gsplat::kLog2AlphaCutoff;
using gsplat::kMinTransmittance;

constexpr int kHalves = (kBlocks + 31) / 32;  // bit set of a splat's blocks, 32 per int

// Direction (x or y) of the ray through a pixel.
GSPLAT_INLINE vfloat direction(vfloat pixel, float centre, float focal) { return (pixel - centre) * (1.0f / focal); }

// Call on_block(id, at, ray, weight) for every splat and every block of pixels in which it may have a
// weight, and after(position) after the last block of a splat.
template <class OnBlock, class After>
GSPLAT_INLINE void traverse(const Splats& splats, const Tile& tile, const OnBlock& on_block, const After& after) {
  const gsplat::compositing::Splats& in = splats.listed;
  const Pinhole& camera = splats.in.before;
  alignas(64) float through[kPixels] = {};
  uint64_t alive = 0;
  for (int y = 0; y < tile.bottom - tile.y; ++y)
    for (int x = 0; x < tile.right - tile.x; ++x) {
      through[place(x, y)] = 1;
      alive |= uint64_t(1) << (place(x, y) / kLanes);
    }
  const vfloat block_x = lane_x() + (float(tile.x) + 0.5f), block_y = lane_y() + (float(tile.y) + 0.5f);
  for (int64_t first = tile.begin; first < tile.end && alive != 0; first += kLanes) {
    const int32_t* const ids = in.flatten_ids + first;
    const int count = tile.end - first < kLanes ? int(tile.end - first) : kLanes;
    prefetch_records(in, first + kLanes, kLanes);
    vint sets[kHalves] = {};
    test_blocks(in.records, ids, count, float(tile.x) + 0.5f, float(tile.y) + 0.5f,
                [&](int block, vmask hit) { sets[block / 32] = or_where(hit, sets[block / 32], int32_t(1u << (block % 32))); });
    alignas(64) uint32_t touched[kHalves][kLanes];
    __builtin_memcpy(touched, sets, sizeof(touched));
    for (int i = 0; i < count; ++i) {
      uint64_t blocks = touched[0][i];
      if constexpr (kHalves > 1) blocks |= uint64_t(touched[kHalves - 1][i]) << 32;
      blocks &= alive;
      if (blocks == 0) continue;
      const gsplat::compositing::SplatRecord& record = in.records[ids[i]];
      for (; blocks != 0; blocks &= blocks - 1) {
        const int block = __builtin_ctzll(blocks), at = block * kLanes;
        const vfloat x = block_x + float(block % kColumns * kBlockWidth), y = block_y + float(block / kColumns * kBlockHeight);
        const auto from_mean = falloff(record, x, y);
        const vfloat power = from_mean.power, front = load(through + at);
        const vmask valid = at_least(power, splat(kLog2AlphaCutoff)) & at_least(splat(record.cap), power);
        const vfloat alpha = zero_unless(valid, exp2(smaller(power, splat(in.alpha.log2_most))));
        const vfloat next = fma(-alpha, front, front);
        const vmask open = above(next, splat(kMinTransmittance));
        store(through + at, next);
        if (lanes_of(open) == 0) alive &= ~(uint64_t(1) << block);
        const Ray ray = {from_mean.dx, from_mean.dy, direction(x, camera.cx, camera.fx), direction(y, camera.cy, camera.fy)};
        on_block(ids[i], at, ray, zero_unless(open, alpha * front));
      }
      after(ids[i], first + i);
    }
  }
}

}  // namespace

static void tile(const Splats& splats, int64_t index, float* out) {
  const Inputs& in = splats.in;
  const Tile t = tile_of(splats.listed, index);
  alignas(64) float sums[kChannels * kPixels] = {};
  traverse(
      splats, t,
      [&](int32_t id, int at, const Ray& ray, vfloat weight) {
        const Moved m =
            moved(in.rays + int64_t(id) * kRayNumbers, in.planes + int64_t(id) * kPlaneNumbers, in.before, in.after, ray);
        const vfloat w = select(m.in_front, weight, vfloat{});
        const vfloat added[kChannels] = {w * m.flow_x, w * m.flow_y, w * m.p[2], w};
        for (int c = 0; c < kChannels; ++c) store(sums + c * kPixels + at, load(sums + c * kPixels + at) + added[c]);
      },
      [](int32_t, int64_t) {});
  for (int y = t.y; y < t.bottom; ++y)
    for (int x = t.x; x < t.right; ++x)
      for (int c = 0; c < kChannels; ++c)
        out[(int64_t(y) * in.width + x) * kChannels + c] = sums[c * kPixels + place(x - t.x, y - t.y)];
}

static void tile_backward(const Splats& splats, int64_t index, const float* v_out, const GradientRows& rows) {
  const Inputs& in = splats.in;
  const Tile t = tile_of(splats.listed, index);
  for (int64_t position = t.begin; position < t.end; ++position)
    for (int k = 0; k < kPlaneNumbers; ++k) rows.rows[rows.row_of[position] * rows.row_size + k] = 0;
  alignas(64) float given[kChannels * kPixels] = {};
  for (int y = t.y; y < t.bottom; ++y)
    for (int x = t.x; x < t.right; ++x)
      for (int c = 0; c < kChannels; ++c)
        given[c * kPixels + place(x - t.x, y - t.y)] = v_out[(int64_t(y) * in.width + x) * kChannels + c];
  vfloat sum[kPlaneNumbers] = {};
  traverse(
      splats, t,
      [&](int32_t id, int at, const Ray& ray, vfloat weight) {
        const Moved m =
            moved(in.rays + int64_t(id) * kRayNumbers, in.planes + int64_t(id) * kPlaneNumbers, in.before, in.after, ray);
        vfloat v[3], v_p[3];
        for (int c = 0; c < 3; ++c) v[c] = load(given + c * kPixels + at);
        moved_backward(m, in.after, select(m.in_front, weight, vfloat{}), v, v_p);
        for (int k = 0; k < 3; ++k) {
          const vfloat along = v_p[k] * m.depth_on_ray;
          sum[k] += v_p[k];
          sum[3 + 3 * k] += along * ray.x;
          sum[4 + 3 * k] += along * ray.y;
          sum[5 + 3 * k] += along;
        }
      },
      [&](int32_t, int64_t position) {
        sums<kPlaneNumbers>(sum, rows.rows + rows.row_of[position] * rows.row_size);
        for (vfloat& value : sum) value = vfloat{};
      });
}

extern const Kernels kernels = {tile, tile_backward};

}  // namespace GSPLAT_ISA::flow_blending
