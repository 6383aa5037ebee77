// Sums of gradient rows over many Gaussians. The first is the gradient of the lines: the Gaussians of a line's cell are
// contiguous in the order of the plane whose major axis is the line's axis. The second is the sums of dense cells of
// the space planes.
#include "cuda_scratch.h"
#include "plane_update.cuh"

namespace gsplat::hexplane {
namespace {

constexpr int kRun = 32;        // sorted Gaussians per team
constexpr int kRunBatch = 8;    // rows in flight
constexpr int kDenseBatch = 4;  // rows in flight for dense cells, which have four sums

// One line's Gaussians and the destinations of their sums. The sums of run r in cell c have index r + c. The index is
// unique, because neither r nor c decreases from one item to the next.
struct LineRuns {
  int32_t begin, end, minor_size, width;
  float* sums;  // [runs + cells, 2, C]: for the left node and the right node

  __device__ LineRuns(const FieldPlanes& planes, const FieldCells& cells, int slot, int runs, float* all) {
    const int level = slot / 3, axis = slot % 3, plane = plane_of_major(axis);
    width = planes.sizes[level][axis], minor_size = planes.sizes[level][minor_axis(plane)];
    const int32_t* starts = cells.starts + cells.first[level][plane];
    begin = starts[0], end = starts[int64_t(width) * minor_size];
    int64_t before = int64_t(slot) * runs;
    for (int s = 0; s < slot; ++s) before += planes.sizes[s / 3][s % 3];
    sums = all + before * 2 * planes.channels;
  }
};

template <int kLane, int kTeam>
__global__ void __launch_bounds__(kThreads) sum_runs(FieldPlanes planes, FieldCells cells, FieldRows rows, int runs, float* all) {
  const int slot = int(blockIdx.y), run = int(blockIdx.x) * (kThreads / kTeam) + int(threadIdx.x) / kTeam,
            channels = planes.channels;
  const LineRuns line(planes, cells, slot, runs, all);
  const int32_t begin = line.begin + run * kRun, end = min(begin + kRun, line.end);
  if (begin >= end) return;
  const int level = slot / 3, axis = slot % 3;
  SortedCells sorted = {nullptr, rows.space, rows.fractions, nullptr, 0};
  sorted.rows = rows.lines;
  const int64_t first_cell = cells.first[level][plane_of_major(axis)];
  for (int c = int(threadIdx.x) % kTeam * kLane; c < channels; c += kTeam * kLane) {
    Channels<kLane> left = Channels<kLane>::all(0.0f), right = left;
    int cell = -1;
    const auto flush = [&] {
      float* to = line.sums + (int64_t(run) + cell) * 2 * channels + c;
      left.store(to);
      right.store(to + channels);
      left = right = Channels<kLane>::all(0.0f);
    };
    for_rows<kLane, kRunBatch>(sorted, begin, end, c, channels, [&](int32_t i, float along, float, const Channels<kLane>& row) {
      const int now = int((cell_of(cells.keys[i]) - first_cell) / line.minor_size);
      if (now != cell && cell >= 0) flush();
      cell = now;
      left = plus(left, 1.0f - along, row);
      right = plus(right, along, row);
    });
    flush();
  }
}

// A block adds the run sums of one node, from the cells on its right and on its left.
template <int kLane, int kTeam>
__global__ void __launch_bounds__(kThreads)
    add_runs(FieldPlanes planes, FieldLines lines, FieldCells cells, int runs, float* all, float* gradient) {
  constexpr int kTeams = kThreads / kTeam;
  __shared__ float shared[kTeams][kTeam * kLane];
  const int slot = int(blockIdx.y), level = slot / 3, axis = slot % 3, node = int(blockIdx.x), channels = planes.channels;
  const LineRuns line(planes, cells, slot, runs, all);
  if (node >= line.width) return;
  const int32_t* starts = cells.starts + cells.first[level][plane_of_major(axis)];
  const int lane = int(threadIdx.x) % kTeam, team = int(threadIdx.x) / kTeam;
  for (int c0 = 0; c0 < channels; c0 += kTeam * kLane) {
    const int c = c0 + lane * kLane;
    Channels<kLane> sum = Channels<kLane>::all(0.0f);
    for (int side = 0; side < 2 && c < channels; ++side) {
      const int cell = node - side;
      if (cell < 0) continue;
      const int32_t from = starts[int64_t(cell) * line.minor_size] - line.begin,
                    to = starts[int64_t(cell + 1) * line.minor_size] - line.begin;
      if (from == to) continue;
#pragma unroll 4
      for (int run = from / kRun + team; run <= (to - 1) / kRun; run += kTeams)
        sum = plus(sum, 1.0f, Channels<kLane>::load(line.sums + ((int64_t(run) + cell) * 2 + side) * channels + c));
    }
    __syncthreads();
    for (int i = 0; i < kLane; ++i) shared[team][lane * kLane + i] = sum.v[i];
    __syncthreads();
    for (int i = int(threadIdx.x); i < kTeam * kLane && c0 + i < channels; i += kThreads) {
      float total = 0.0f;
      for (int t = 0; t < kTeams; ++t) total += shared[t][i];
      gradient[lines.starts[level][axis] + int64_t(node) * channels + c0 + i] = total;
    }
  }
}

// A team processes one run: it sums the rows of dense cells, cell by cell, for the cells' four corners.
template <int kLane, int kTeam>
__global__ void __launch_bounds__(kThreads) dense_cell_sums(FieldCells cells, FieldRows rows, int channels, int runs) {
  const int run = (int(blockIdx.x) * kThreads + int(threadIdx.x)) / kTeam;
  if (run >= runs) return;
  const int32_t begin = run * kDenseRun,
                end = min(begin + kDenseRun, cells.starts[cells.cells]);  // followed by excluded Gaussians
  for (int c = int(threadIdx.x) % kTeam * kLane; c < channels; c += kTeam * kLane) {
    Channels<kLane> sums[4];
    uint32_t now = 0;
    int64_t place = 0;
    const auto flush = [&] {
#pragma unroll
      for (int corner = 0; corner < 4; ++corner) sums[corner].store(rows.dense_sums + (place + corner) * channels + c);
    };
    for (int32_t i = begin; i < end; i += kDenseBatch) {
      uint32_t key[kDenseBatch];
      Channels<kLane> row[kDenseBatch];
      float2 share[kDenseBatch];
#pragma unroll
      for (int k = 0; k < kDenseBatch; ++k) key[k] = i + k < end ? cells.keys[i + k] : 0;
#pragma unroll
      for (int k = 0; k < kDenseBatch; ++k) {
        if (!is_dense(key[k])) continue;
        row[k] = Channels<kLane>::load(rows.space + int64_t(i + k) * channels + c);
        share[k] = *reinterpret_cast<const float2*>(rows.fractions + 2 * int64_t(i + k));
      }
#pragma unroll
      for (int k = 0; k < kDenseBatch; ++k) {
        if (!is_dense(key[k])) continue;
        if (key[k] != now) {
          if (now != 0) flush();
          now = key[k];
          const bool begins = i + k > begin || begin == 0 || cells.keys[begin - 1] != now;
          place = dense_place(run, begins, i + k, 0);
#pragma unroll
          for (int corner = 0; corner < 4; ++corner) sums[corner] = Channels<kLane>::all(0.0f);
        }
        const float along[2] = {1.0f - share[k].x, share[k].x}, across[2] = {1.0f - share[k].y, share[k].y};
#pragma unroll
        for (int corner = 0; corner < 4; ++corner)
          sums[corner] = plus(sums[corner], along[corner / 2] * across[corner % 2], row[k]);
      }
    }
    if (now != 0) flush();
  }
}

}  // namespace

void sum_dense_cells(const FieldPlanes& planes, const FieldCells& cells, const FieldRows& rows, cudaStream_t stream) {
  const int runs = int(blocks_for(3 * planes.levels * cells.count, kDenseRun));
  if (runs == 0) return;
  with_wide_team(planes.channels, [&](auto lane, auto team) {
    dense_cell_sums<lane(), team()>
        <<<blocks_for(int64_t(runs) * team()), kThreads, 0, stream>>>(cells, rows, planes.channels, runs);
  });
}

void line_gradient(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const FieldRows& rows,
                   float* gradient, CudaScratch& scratch, cudaStream_t stream) {
  const int runs = int((cells.count + kRun - 1) / kRun), slots = 3 * planes.levels;
  int64_t places = int64_t(slots) * runs;
  int32_t widest = 0;
  for (int slot = 0; slot < slots; ++slot) {
    const int32_t width = planes.sizes[slot / 3][slot % 3];
    places += width;
    widest = width > widest ? width : widest;
  }
  float* sums = scratch.array<float>(places * 2 * planes.channels);
  with_wide_team(planes.channels, [&](auto lane, auto team) {
    if (runs > 0)
      sum_runs<lane(), team()>
          <<<dim3(blocks_for(runs, kThreads / team()), unsigned(slots)), kThreads, 0, stream>>>(planes, cells, rows, runs, sums);
    add_runs<lane(), team()>
        <<<dim3(unsigned(widest), unsigned(slots)), kThreads, 0, stream>>>(planes, lines, cells, runs, sums, gradient);
  });
}

}  // namespace gsplat::hexplane
