// The gradient of the lines: the Gaussians of a line's cell lie together in the order of the plane that has the axis as its
// major.
#include "plane_samples.cuh"
#include "team_launch.h"
#include "training_cuda.h"

using namespace hexplane;

namespace {

constexpr int plane_of_major(int axis) { return axis == 0 ? 1 : axis == 1 ? 0 : 2; }  // x: xz, y: xy, z: yz

// Sums of one part of a cell's Gaussians: for its left node at parts[part][0], for its right one at parts[part][1].
template <int kLane, int kTeam>
__global__ void __launch_bounds__(kThreads) sum_parts(FieldPlanes planes, FieldLines lines, FieldCells cells,
                                                      const float* __restrict__ rows, float* parts, int64_t size) {
  constexpr int kTeams = kThreads / kTeam;
  __shared__ float shared[2][kTeams][kTeam * kLane];
  const int slot = int(blockIdx.y), level = slot / 3, axis = slot % 3, plane = plane_of_major(axis), part = int(blockIdx.z);
  const int width = lines.widths[level][axis], cell = int(blockIdx.x);
  if (cell >= width) return;
  const int64_t minor = planes.sizes[level][minor_axis(plane)], key = cells.first[level][plane] + cell * minor;
  const int64_t from = cells.starts[key], count = cells.starts[key + minor] - from;
  const int64_t begin = from + count * part / kLineParts, end = from + count * (part + 1) / kLineParts;
  const int lane = int(threadIdx.x) % kTeam, team = int(threadIdx.x) / kTeam, channels = planes.channels;
  const int64_t first_item = (3 * level + plane) * cells.count;
  for (int c0 = 0; c0 < channels; c0 += kTeam * kLane) {
    const int c = c0 + lane * kLane;
    Channels<kLane> left = Channels<kLane>::all(0.0f), right = left;
    if (c < channels) {
#pragma unroll 4
      for (int64_t i = begin + team; i < end; i += kTeams) {
        const int64_t n = cells.items[i] - first_item;
        const float share = position_on(cells.coordinates[4 * n + axis], width).fraction;
        const auto g = Channels<kLane>::load(rows + (slot * cells.count + n) * channels + c);
        left = plus(left, 1.0f - share, g);
        right = plus(right, share, g);
      }
    }
    __syncthreads();
    for (int i = 0; i < kLane; ++i) {
      shared[0][team][lane * kLane + i] = left.v[i];
      shared[1][team][lane * kLane + i] = right.v[i];
    }
    __syncthreads();
    for (int i = int(threadIdx.x); i < 2 * kTeam * kLane; i += kThreads) {
      const int side = i / (kTeam * kLane), at = i % (kTeam * kLane);
      if (c0 + at >= channels) continue;
      float sum = 0.0f;
      for (int t = 0; t < kTeams; ++t) sum += shared[side][t][at];
      parts[(2 * part + side) * size + lines.starts[level][axis] + cell * channels + c0 + at] = sum;
    }
  }
}

__global__ void __launch_bounds__(kThreads)
    add_parts(FieldLines lines, int channels, const float* __restrict__ parts, int64_t size, float* gradient) {
  const int level = int(blockIdx.y) / 3, axis = int(blockIdx.y) % 3;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x, start = lines.starts[level][axis];
  if (i >= int64_t(lines.widths[level][axis]) * channels) return;
  float sum = 0.0f;
  for (int part = 0; part < kLineParts; ++part) {
    sum += parts[2 * part * size + start + i];
    if (i >= channels) sum += parts[(2 * part + 1) * size + start + i - channels];
  }
  gradient[start + i] = sum;
}

}  // namespace

void line_gradient(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const FieldRows& rows,
                   float* gradient, CudaScratch& scratch, cudaStream_t stream) {
  int64_t size = 0;
  int32_t widest = 0;
  for (int l = 0; l < planes.levels; ++l)
    for (const int32_t width : lines.widths[l]) {
      size += int64_t(width) * planes.channels;
      widest = width > widest ? width : widest;
    }
  float* parts = scratch.array<float>(2 * kLineParts * size);
  const unsigned slots = unsigned(3 * planes.levels);
  const bool wide = planes.channels % 4 == 0 && uintptr_t(rows.lines) % 16 == 0;
  with_team(wide, planes.channels, [&](auto lane, auto team) {
    sum_parts<lane(), team()>
        <<<dim3(unsigned(widest), slots, kLineParts), kThreads, 0, stream>>>(planes, lines, cells, rows.lines, parts, size);
  });
  add_parts<<<dim3(blocks_for(int64_t(widest) * planes.channels), slots), kThreads, 0, stream>>>(lines, planes.channels, parts,
                                                                                                 size, gradient);
}
