// Adam over the planes with penalties. A penalty's gradient needs the old values of a node's neighbours, while the
// plane is updated in place.
//
// Space planes: a block processes a tile of nodes row by row. It keeps the old previous and current rows, which its
// threads exchange in shared memory. Neighbours in other tiles are read from copies of the tile borders made by a first
// pass, so blocks do not depend on each other's progress. Time planes: a thread iterates along time, and all neighbours
// belong to the same thread.
#include "cuda_scratch.h"
#include "plane_update.cuh"

namespace gsplat::hexplane {
namespace {

constexpr int kTileThreads = 512, kTileRows = 32;

// Tiles of all space planes. `borders` holds copies, taken before the update, of the rows and columns on both sides of
// each tile boundary. Blocks read neighbour values from them, because other blocks update the planes concurrently.
struct Tiles {
  PlaneBlocks blocks;
  int32_t nodes;                        // nodes per tile along U
  int32_t across[3 * kMaxFieldLevels];  // tiles along U
  int64_t rows[3 * kMaxFieldLevels];  // offset in `borders` of [tiles along V + 1, 2, U * C], the rows above and below a boundary
  int64_t columns[3 * kMaxFieldLevels];  // offset of [tiles along U + 1, 2, V, C], the columns left and right of a boundary
  float* borders;
};

struct Tile {
  int slot, level, p, width, height;
  int column, row;  // position of the tile
  int first_u, end_u, first_v, end_v;
  int u, channel;  // position of the thread
  bool inside;

  __device__ Tile(const FieldPlanes& planes, const Tiles& tiles, int lane) {
    slot = slot_of_block(tiles.blocks);
    level = slot / 3, p = slot % 3;
    width = planes.sizes[level][u_axis(p)], height = planes.sizes[level][v_axis(p)];
    const int index = int(blockIdx.x) - tiles.blocks.first_block[slot];
    column = index % tiles.across[slot], row = index / tiles.across[slot];
    first_u = column * tiles.nodes, end_u = min(first_u + tiles.nodes, width);
    first_v = row * kTileRows, end_v = min(first_v + kTileRows, height);
    const int at = int(threadIdx.x) * lane;
    u = first_u + at / planes.channels, channel = at % planes.channels;
    inside = u < end_u;
  }
  __device__ float* border_row(const Tiles& tiles, int boundary, int side, int channels) const {
    return tiles.borders + tiles.rows[slot] + ((2 * boundary + side) * int64_t(width) + u) * channels + channel;
  }
  __device__ float* border_column(const Tiles& tiles, int boundary, int side, int v, int channels) const {
    return tiles.borders + tiles.columns[slot] + ((2 * boundary + side) * int64_t(height) + v) * channels + channel;
  }
};

template <int kLane>
__global__ void __launch_bounds__(kTileThreads) copy_borders(FieldPlanes planes, PlanesState state, Tiles tiles) {
  const Tile tile(planes, tiles, kLane);
  if (!tile.inside) return;
  const int channels = planes.channels;
  const float* plane = state.space[tile.level][tile.p].values;
  const auto old = [&](int v) {
    return Channels<kLane>::load(plane + (int64_t(v) * tile.width + tile.u) * channels + tile.channel);
  };
  old(tile.first_v).store(tile.border_row(tiles, tile.row, 1, channels));
  old(tile.end_v - 1).store(tile.border_row(tiles, tile.row + 1, 0, channels));
  for (int v = tile.first_v; v < tile.end_v; ++v) {
    if (tile.u == tile.first_u) old(v).store(tile.border_column(tiles, tile.column, 1, v, channels));
    if (tile.u == tile.end_u - 1) old(v).store(tile.border_column(tiles, tile.column + 1, 0, v, channels));
  }
}

template <int kLane>
__global__ void __launch_bounds__(kTileThreads, 2)
    space_tiles(FieldPlanes planes, FieldCells cells, FieldRows rows, PlanesState state, Tiles tiles, float smoothness,
                const AdamScalars* scalars) {
  __shared__ float row_values[2][kTileThreads * kLane];
  if (scalars->skip) return;
  const Tile tile(planes, tiles, kLane);
  const AdamStep step = scalars->step;
  const int channels = planes.channels, width = tile.width, height = tile.height;
  const PlaneMoments& plane = state.space[tile.level][tile.p];
  // Gradient factor of a mean of squared differences: 2 / (number of differences).
  const float along_u = width > 1 ? 2.0f * smoothness / (float(width - 1) * float(height) * float(channels)) : 0.0f;
  const float along_v = height > 1 ? 2.0f * smoothness / (float(width) * float(height - 1) * float(channels)) : 0.0f;
  const auto place = [&](int v) { return (int64_t(v) * width + tile.u) * channels + tile.channel; };
  Channels<kLane> above = Channels<kLane>::all(0.0f), current = above;
  if (tile.inside) {
    current = Channels<kLane>::load(plane.values + place(tile.first_v));
    above = tile.row > 0 ? Channels<kLane>::load(tile.border_row(tiles, tile.row, 0, channels)) : current;
  }
  for (int v = tile.first_v; v < tile.end_v; ++v) {
    float* row_now = row_values[v % 2];  // two buffers, so that one barrier per row suffices
    current.store(row_now + threadIdx.x * kLane);
    __syncthreads();
    if (!tile.inside) continue;
    Channels<kLane> below = current, left = current, right = current;
    if (v + 1 < tile.end_v) {
      below = Channels<kLane>::load(plane.values + place(v + 1));
    } else if (v + 1 < height) {
      below = Channels<kLane>::load(tile.border_row(tiles, tile.row + 1, 1, channels));
    }
    if (tile.u > tile.first_u) {
      left = Channels<kLane>::load(row_now + threadIdx.x * kLane - channels);
    } else if (tile.u > 0) {
      left = Channels<kLane>::load(tile.border_column(tiles, tile.column, 0, v, channels));
    }
    if (tile.u + 1 < tile.end_u) {
      right = Channels<kLane>::load(row_now + threadIdx.x * kLane + channels);
    } else if (tile.u + 1 < width) {
      right = Channels<kLane>::load(tile.border_column(tiles, tile.column + 1, 1, v, channels));
    }
    Channels<kLane> gradient = space_gradient<kLane>(planes, cells, rows, tile.slot, tile.u, v, tile.channel);
    gradient = plus(gradient, along_u, (current - left) - (right - current));
    gradient = plus(gradient, along_v, (current - above) - (below - current));
    update<kLane>(plane, place(v), [&] { return current; }, [&] { return gradient; }, step);
    above = current;
    current = below;
  }
}

template <int kLane>
__global__ void __launch_bounds__(kThreads)
    time_columns(FieldLines lines, const float* __restrict__ line_gradient, const float* time, int32_t channels,
                 PlaneBlocks slots, PlanesState state, float smoothness, float sparsity, const AdamScalars* scalars) {
  if (scalars->skip) return;
  const int slot = slot_of_block(slots), level = slot / 3, axis = slot % 3, rows = state.time_rows[level][axis];
  const int64_t size = int64_t(lines.widths[level][axis]) * channels;
  const int64_t column = (int64_t(int(blockIdx.x) - slots.first_block[slot]) * kThreads + threadIdx.x) * kLane;
  if (column >= size) return;
  const AdamStep step = scalars->step;
  const PlaneMoments& plane = state.time[level][axis];
  const LinePosition now = position_on(*time, rows);
  const auto v_line = Channels<kLane>::load(line_gradient + lines.starts[level][axis] + column);
  const float bend = rows > 2 ? 2.0f * smoothness / (float(rows - 2) * float(size)) : 0.0f;
  const float away = sparsity / (float(rows) * float(size));
  const auto old = [&](int v) { return Channels<kLane>::load(plane.values + (v < rows ? v : rows - 1) * size + column); };
  // bends[i]: second difference at rows v - 2 + i; 0 where it would extend beyond the plane
  Channels<kLane> bends[3] = {Channels<kLane>::all(0.0f), Channels<kLane>::all(0.0f), Channels<kLane>::all(0.0f)};
  Channels<kLane> window[3] = {old(0), old(1), old(2)};  // old values of rows v, v + 1, v + 2
#pragma unroll 2
  for (int v = 0; v < rows; ++v) {
    const Channels<kLane> next = old(v + 3);
    bends[2] = v + 2 < rows ? (window[0] - window[1]) - (window[1] - window[2]) : Channels<kLane>::all(0.0f);
    Channels<kLane> gradient = Channels<kLane>::all(weight_of(now, v)) * v_line;
    gradient = plus(gradient, bend, (bends[2] - bends[1]) - (bends[1] - bends[0]));
#pragma unroll
    for (int i = 0; i < kLane; ++i) {
      const float apart = window[0].v[i] - 1.0f;
      gradient.v[i] += apart > 0.0f ? away : apart < 0.0f ? -away : 0.0f;
    }
    update<kLane>(plane, v * size + column, [&] { return window[0]; }, [&] { return gradient; }, step);
    bends[0] = bends[1], bends[1] = bends[2];
    window[0] = window[1], window[1] = window[2], window[2] = next;
  }
}

template <int kLane>
Tiles make_tiles(const FieldPlanes& planes, CudaScratch& scratch) {
  Tiles tiles = {};
  tiles.nodes = kTileThreads * kLane / planes.channels;
  int64_t size = 0;
  for (int slot = 0; slot < 3 * planes.levels; ++slot) {
    const FeaturePlane plane = planes.plane(slot / 3, slot % 3);
    const int32_t across = (plane.width + tiles.nodes - 1) / tiles.nodes, down = (plane.height + kTileRows - 1) / kTileRows;
    tiles.across[slot] = across;
    tiles.blocks.first_block[slot + 1] = tiles.blocks.first_block[slot] + across * down;
    tiles.rows[slot] = size;
    size += int64_t(down + 1) * 2 * plane.width * planes.channels;
    tiles.columns[slot] = size;
    size += int64_t(across + 1) * 2 * plane.height * planes.channels;
  }
  tiles.blocks.count = 3 * planes.levels;
  tiles.borders = scratch.array<float>(size);
  return tiles;
}

template <int kLane>
void smooth_space(const FieldPlanes& planes, const FieldCells& cells, const FieldRows& rows, const PlanesState& state,
                  float smoothness, const AdamScalars* scalars, CudaScratch& scratch, cudaStream_t stream) {
  const Tiles tiles = make_tiles<kLane>(planes, scratch);
  const unsigned blocks = unsigned(tiles.blocks.first_block[tiles.blocks.count]);
  copy_borders<kLane><<<blocks, kTileThreads, 0, stream>>>(planes, state, tiles);
  space_tiles<kLane>
      <<<blocks, kTileThreads, 0, stream>>>(planes, cells, rows, state, tiles, smoothness / tiles.blocks.count, scalars);
}

template <int kLane>
void smooth_time(const FieldPlanes& planes, const FieldLines& lines, const float* line_gradient, const float* time,
                 const PlanesState& state, const PlanePenalties& penalties, const AdamScalars* scalars, cudaStream_t stream) {
  PlaneBlocks slots = {};
  slots.count = 3 * planes.levels;
  for (int slot = 0; slot < slots.count; ++slot)
    slots.first_block[slot + 1] =
        slots.first_block[slot] +
        int32_t(blocks_for(int64_t(lines.widths[slot / 3][slot % 3]) * planes.channels, kThreads * kLane));
  time_columns<kLane><<<unsigned(slots.first_block[slots.count]), kThreads, 0, stream>>>(
      lines, line_gradient, time, planes.channels, slots, state, penalties.time_smoothness / slots.count,
      penalties.sparsity / slots.count, scalars);
}

}  // namespace

void smooth_space_planes(bool wide, const FieldPlanes& planes, const FieldCells& cells, const FieldRows& rows,
                         const PlanesState& state, float smoothness, const AdamScalars* scalars, CudaScratch& scratch,
                         cudaStream_t stream) {
  (wide ? smooth_space<4> : smooth_space<1>)(planes, cells, rows, state, smoothness, scalars, scratch, stream);
}

void smooth_time_planes(const FieldPlanes& planes, const FieldLines& lines, const float* line_gradient, const float* time,
                        const PlanesState& state, const PlanePenalties& penalties, const AdamScalars* scalars,
                        cudaStream_t stream) {
  smooth_time<1>(planes, lines, line_gradient, time, state, penalties, scalars, stream);
}

}  // namespace gsplat::hexplane
