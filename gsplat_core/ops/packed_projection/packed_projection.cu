#include "packed_projection.h"

#include "../projection/projection_device.cuh"
#include "cub_device.cuh"
#include "cuda_check.h"

namespace gsplat::packed_projection {
namespace {

using namespace projection;

constexpr int kWarps = kThreads / 32;

struct Pair {
  int64_t image, gaussian, block;  // block within the image
};
__device__ inline Pair pair_of(const ProjectionSize& size) {
  const int64_t per_image = (size.gaussians + kThreads - 1) / kThreads;
  const int64_t image = blockIdx.x / per_image, block = blockIdx.x % per_image;
  return {image, block * kThreads + threadIdx.x, block};
}

template <CameraModel model>
__device__ inline Projected project_pair(const ProjectionInput& all, const ProjectionSize& size, const Pair& pair,
                                         bool compensate) {
  const ProjectionInput in = of_camera(all, size, pair.image / size.cameras, pair.image % size.cameras);
  float mean[3];
  for (int k = 0; k < 3; ++k) mean[k] = in.means[3 * pair.gaussian + k];
  return project(in, View<model>(in), mean, load_geometry(in, pair.gaussian),
                 in.opacities != nullptr ? in.opacities + pair.gaussian : nullptr, compensate);
}

template <CameraModel model>
__global__ void __launch_bounds__(kThreads)
    find(ProjectionInput all, ProjectionSize size, bool compensate, uint32_t* bits, int64_t* counts) {
  const Pair pair = pair_of(size);
  const bool valid = pair.gaussian < size.gaussians && project_pair<model>(all, size, pair, compensate).valid;
  const uint32_t word = __ballot_sync(~0u, valid);
  __shared__ int in_warp[kWarps];
  if (threadIdx.x % 32 == 0) {
    bits[int64_t(blockIdx.x) * kWarps + threadIdx.x / 32] = word;
    in_warp[threadIdx.x / 32] = __popc(word);
  }
  __syncthreads();
  if (threadIdx.x > 0) return;
  int total = 0;
  for (int w = 0; w < kWarps; ++w) total += in_warp[w];
  counts[blockIdx.x] = total;
}

template <CameraModel model>
__global__ void __launch_bounds__(kThreads) emit(ProjectionInput all, ProjectionSize size, Visible visible, RowOutput out) {
  const Pair pair = pair_of(size);
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  const uint32_t* const words = visible.bits + int64_t(blockIdx.x) * kWarps;
  if ((words[warp] >> lane & 1) == 0) return;
  int64_t row = visible.starts[blockIdx.x] + __popc(words[warp] & ((1u << lane) - 1));
  for (int w = 0; w < warp; ++w) row += __popc(words[w]);
  const bool compensate = out.compensations != nullptr;
  const Projected p = project_pair<model>(all, size, pair, compensate);
  out.ids[row] = pair.image * size.gaussians + pair.gaussian;
  out.radii[2 * row] = int32_t(p.radius_x);
  out.radii[2 * row + 1] = int32_t(p.radius_y);
  out.means2d[2 * row] = p.u;
  out.means2d[2 * row + 1] = p.v;
  out.depths[row] = p.depth;
  for (int k = 0; k < 3; ++k) out.conics[3 * row + k] = p.conic[k];
  if (compensate) out.compensations[row] = p.compensation;
}

// Return the first row whose id is at least `id`; rows are sorted by id.
__device__ inline int64_t first_row(const Rows& rows, int64_t id) {
  int64_t low = 0, high = rows.count;
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (rows.ids[middle] < id)
      low = middle + 1;
    else
      high = middle;
  }
  return low;
}

// Block b of an image processes the rows b * kThreads to (b + 1) * kThreads - 1 of the image, if there are so many.
template <CameraModel model>
__global__ void __launch_bounds__(kThreads)
    backward(ProjectionInput all, ProjectionSize size, Rows rows, RowOutputGradient from, RowGradient to) {
  const Pair pair = pair_of(size);
  const int64_t row = first_row(rows, pair.image * size.gaussians) + pair.gaussian;
  const int64_t gaussian = row < rows.count ? rows.ids[row] - pair.image * size.gaussians : size.gaussians;
  BackProjected g = {};
  if (gaussian >= 0 && gaussian < size.gaussians) {
    const ProjectionInput in = of_camera(all, size, pair.image / size.cameras, pair.image % size.cameras);
    float mean[3];
    for (int k = 0; k < 3; ++k) mean[k] = in.means[3 * gaussian + k];
    ProjectedGradient v = {};
    for (int k = 0; k < 2 && from.means2d != nullptr; ++k) v.means2d[k] = from.means2d[2 * row + k];
    if (from.depths != nullptr) v.depth = from.depths[row];
    for (int k = 0; k < 3 && from.conics != nullptr; ++k) v.conic[k] = from.conics[3 * row + k];
    if (from.compensations != nullptr) v.compensation = from.compensations[row];
    g = project_backward(in, View<model>(in), mean, load_geometry(in, gaussian), v, from.compensations != nullptr,
                         to.viewmat != nullptr);
    for (int k = 0; k < 3; ++k) to.means[3 * row + k] = g.mean[k];
    if (all.covars != nullptr) {
      for (int k = 0; k < 6; ++k) to.covars[6 * row + k] = g.sigma.v[k];
    } else {
      for (int k = 0; k < 4; ++k) to.quats[4 * row + k] = g.quat[k];
      for (int k = 0; k < 3; ++k) to.scales[3 * row + k] = g.scales[k];
    }
  }
  if (to.viewmat != nullptr) sum_over_block<kMatrixSums, kThreads>(g.viewmat, to.viewmat + int64_t(blockIdx.x) * kMatrixSums);
}

// Rows of one camera and batch have different Gaussians, so that no two threads add to one value.
__global__ void __launch_bounds__(kThreads)
    add_of_camera(ProjectionSize size, Rows rows, const float* values, int64_t columns, int64_t camera, float* out) {
  const int64_t i = blockIdx.x * int64_t(kThreads) + threadIdx.x, row = i / columns;
  if (row >= rows.count) return;
  const int64_t image = rows.ids[row] / size.gaussians, batch = image / size.cameras;
  if (image % size.cameras != camera || rows.ids[row] < 0 || batch >= size.batches) return;
  out[(batch * size.gaussians + rows.ids[row] % size.gaussians) * columns + i % columns] += values[i];
}

}  // namespace

int64_t blocks(const ProjectionSize& size) { return size.batches * size.cameras * blocks_for(size.gaussians); }

Visible find_visible(const ProjectionInput& in, const ProjectionSize& size, bool compensate, CudaScratch& scratch,
                     cudaStream_t stream) {
  const int64_t count = blocks(size);
  Visible visible = {scratch.array<uint32_t>(count * kWarps), scratch.array<int64_t>(count + 1)};
  int64_t* const counts = scratch.array<int64_t>(count + 1);
  check_cuda(cudaMemsetAsync(counts + count, 0, sizeof(int64_t), stream), "counting visible Gaussians");
  const auto kernel = in.model == kOrtho ? find<kOrtho> : in.model == kFisheye ? find<kFisheye> : find<kPinhole>;
  kernel<<<unsigned(count), kThreads, 0, stream>>>(in, size, compensate, visible.bits, counts);
  size_t bytes = 0;
  check_cuda(cub::DeviceScan::ExclusiveSum(nullptr, bytes, counts, visible.starts, count + 1, stream),
             "summing numbers of visible Gaussians");
  check_cuda(cub::DeviceScan::ExclusiveSum(scratch.bytes(bytes), bytes, counts, visible.starts, count + 1, stream),
             "summing numbers of visible Gaussians");
  return visible;
}

void emit_rows(const ProjectionInput& in, const ProjectionSize& size, const Visible& visible, const RowOutput& out,
               cudaStream_t stream) {
  const auto kernel = in.model == kOrtho ? emit<kOrtho> : in.model == kFisheye ? emit<kFisheye> : emit<kPinhole>;
  kernel<<<unsigned(blocks(size)), kThreads, 0, stream>>>(in, size, visible, out);
}

void rows_backward(const ProjectionInput& in, const ProjectionSize& size, const Rows& rows, const RowOutputGradient& from,
                   const RowGradient& to, float* v_viewmats, cudaStream_t stream) {
  const int64_t count = blocks(size);
  if (count == 0) return;
  const auto kernel = in.model == kOrtho ? backward<kOrtho> : in.model == kFisheye ? backward<kFisheye> : backward<kPinhole>;
  kernel<<<unsigned(count), kThreads, 0, stream>>>(in, size, rows, from, to);
  if (to.viewmat != nullptr)
    sum_over_blocks<kMatrixSums><<<unsigned(size.batches * size.cameras), 32 * kMatrixSums, 0, stream>>>(
        to.viewmat, blocks_for(size.gaussians), v_viewmats, nullptr);
}

void add_rows(const ProjectionSize& size, const Rows& rows, const float* values, int64_t columns, float* out,
              cudaStream_t stream) {
  if (rows.count * columns == 0) return;
  for (int64_t camera = 0; camera < size.cameras; ++camera)
    add_of_camera<<<blocks_for(rows.count * columns), kThreads, 0, stream>>>(size, rows, values, columns, camera, out);
}

}  // namespace gsplat::packed_projection
