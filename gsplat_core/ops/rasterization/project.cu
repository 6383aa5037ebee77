// Projection, colours and tile counts of all splats, and the packed form of projection's outputs.
#include "../frame/instances.cuh"
#include "dependent_launch.cuh"
#include "gaussians.cuh"

namespace gsplat::rasterization {
namespace {

using namespace blending;
using namespace frame;

// Spherical-harmonics coefficients of a warp's Gaussians; empty for plain colours.
template <int degree>
struct WarpColors {
  StagedHarmonics<degree> coefficients;
};
template <>
struct WarpColors<kPlainColors> {};

template <int degree>
__global__ void __launch_bounds__(frame::kGaussianThreads, degree < 4 ? 7 : 4)
    project_splats(Scene scene, Splats out, frame::Scratch scratch) {
  allow_dependent_launch();
  __shared__ float camera[25], center[3];
  __shared__ WarpColors<degree> warps[frame::kGaussianThreads / 32];
  const int64_t blocks = scene.blocks(), image = blockIdx.x / blocks, batch = image / scene.cameras;
  const int64_t n = blockIdx.x % blocks * frame::kGaussianThreads + threadIdx.x, at = image * scene.gaussians + n;
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  ProjectionInput in = seen_by(scene, batch, image);
  if (threadIdx.x < 25) camera[threadIdx.x] = threadIdx.x < 16 ? in.viewmat[threadIdx.x] : in.intrinsics[threadIdx.x - 16];
  in.viewmat = camera;
  in.intrinsics = camera + 16;
  load_center(scene, image, center);  // contains a barrier

  float mean[3] = {}, opacity = 0;
  Projected p;
  p.valid = 0;
  if (n < scene.gaussians) {
    for (int k = 0; k < 3; ++k) mean[k] = in.means[3 * n + k];
    opacity = in.opacities[n];
    p = projection::project(in, mean, load_geometry(in, n), &opacity, scene.antialiased);
    if (p.valid && scene.antialiased) opacity *= p.compensation;
  }
  float color[3] = {};
  if (scene.colors != nullptr) {
    const int64_t set = (scene.colors_per_camera ? image : batch) * scene.gaussians + n;
    if constexpr (degree == kPlainColors) {
      if (p.valid)
        for (int k = 0; k < scene.channels; ++k) color[k] = scene.colors[set * scene.color_row + k];
    } else {
      const unsigned shown = __ballot_sync(kWholeWarp, p.valid);
      const float* const rows = scene.colors + (set - lane) * scene.color_row;
      warps[warp].coefficients.load(rows, scene.color_row, shown, reinterpret_cast<uintptr_t>(rows) % 16 == 0);
      float direction[3], bases[kBasesOf<degree>];
      unit_direction(center, mean, direction);
      bases_at<degree>(direction[0], direction[1], direction[2], bases);
      warps[warp].coefficients.wait();
      if (p.valid) warps[warp].coefficients.add_color(bases, color);
    }
    if (!(0 * color[0] + 0 * color[1] + 0 * color[2] == 0)) p.valid = 0;  // 0 x is 0 for finite x, otherwise NaN
    if constexpr (degree != kPlainColors)
      for (int j = 0; j < 3; ++j) color[j] = fmaxf(color[j] + 0.5f, 0.0f);
  }

  Footprint footprint = {0, 0};
  if (p.valid) {
    Record<4> r = {};
    set_shape(r, p.u, p.v, p.conic, log2f(opacity));
    for (int j = 0; j < 3; ++j) r.colors[j] = color[j];
    r.colors[3] = p.depth;
    reinterpret_cast<Record<4>*>(out.records)[at] = r;
    TileBox box = box_around(p.u, p.v, p.radius_x, p.radius_y, frame::kTile, scene.tile_width, scene.tile_height);
    box.ellipse = ellipse_of_record(r.xyab, r.c, r.l);
    footprint = footprint_of(box);
  }
  const auto count = [&](int tile, int) {
    atomicAdd(scratch.counters + (image * scene.tiles() + tile) * scratch.counter_stride, 1u);
  };
  for_each_small_tile(footprint, scene.tile_width, count);
  uint32_t tiles = uint32_t(footprint.small_count());
  __syncwarp();  // records of large footprints are visible to the warp
  for_each_large(footprint, [&](int owner) {
    const Record<4>* const records = reinterpret_cast<const Record<4>*>(out.records) + image * scene.gaussians;
    const int of_large = for_each_large_tile(footprint, records, n, owner, scene.tile_width, count);
    if (lane == owner) tiles = uint32_t(of_large);
  });
  __shared__ uint32_t of_warps[32];
  const uint32_t sum = sum_over_block(tiles, of_warps).all;
  if (threadIdx.x == 0) scratch.block_counts[blockIdx.x] = sum;
  if (n >= scene.gaussians) return;
  scratch.footprints[at] = make_uint2(footprint.x, footprint.y);
  scratch.depths[at] = __float_as_uint(p.depth);
  const bool valid = p.valid != 0;
  reinterpret_cast<int2*>(out.radii)[at] = valid ? make_int2(int(p.radius_x), int(p.radius_y)) : make_int2(0, 0);
  reinterpret_cast<float2*>(out.means2d)[at] = valid ? make_float2(p.u, p.v) : make_float2(0, 0);
  out.depths[at] = valid ? p.depth : 0;
  for (int k = 0; k < 3; ++k) out.conics[3 * at + k] = valid ? p.conic[k] : 0;
  if (out.opacities != nullptr) out.opacities[at] = valid ? opacity : 0;
  out.tiles_per_gauss[at] = int32_t(tiles);
}

__global__ void __launch_bounds__(frame::kGaussianThreads)
    count_visible_splats(Scene scene, const int32_t* radii, uint32_t* counts) {
  const int64_t blocks = scene.blocks(), n = blockIdx.x % blocks * frame::kGaussianThreads + threadIdx.x;
  const bool visible = n < scene.gaussians && radii[2 * (blockIdx.x / blocks * scene.gaussians + n)] > 0;
  const int count = __syncthreads_count(visible);
  if (threadIdx.x == 0) counts[blockIdx.x] = uint32_t(count);
}

__global__ void __launch_bounds__(frame::kGaussianThreads)
    pack_splats(Scene scene, Splats splats, const int32_t* block_starts, PackedSplats out) {
  __shared__ uint32_t of_warps[32];
  const int64_t blocks = scene.blocks(), image = blockIdx.x / blocks,
                n = blockIdx.x % blocks * frame::kGaussianThreads + threadIdx.x;
  const int64_t at = image * scene.gaussians + n;
  const bool visible = n < scene.gaussians && splats.radii[2 * at] > 0;
  const int64_t row = block_starts[blockIdx.x] + int64_t(sum_over_block(visible, of_warps).before);
  if (n >= scene.gaussians) return;
  out.row_of[at] = visible ? int32_t(row) : -1;
  if (!visible) return;
  out.batch_ids[row] = image / scene.cameras;
  out.camera_ids[row] = image % scene.cameras;
  out.gaussian_ids[row] = n;
  reinterpret_cast<int2*>(out.rows.radii)[row] = reinterpret_cast<const int2*>(splats.radii)[at];
  reinterpret_cast<float2*>(out.rows.means2d)[row] = reinterpret_cast<const float2*>(splats.means2d)[at];
  out.rows.depths[row] = splats.depths[at];
  for (int k = 0; k < 3; ++k) out.rows.conics[3 * row + k] = splats.conics[3 * at + k];
  const float* const opacities = scene.projection.opacities + image / scene.cameras * scene.gaussians;
  out.rows.opacities[row] = splats.opacities != nullptr ? splats.opacities[at] : opacities[n];
  out.rows.tiles_per_gauss[row] = splats.tiles_per_gauss[at];
}

__global__ void renumber_splats(int64_t length, const int32_t* row_of, const int32_t* from, int32_t* to) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < length) to[i] = row_of[from[i]];
}

}  // namespace

void project(const Scene& scene, const Splats& out, const frame::Scratch& scratch, cudaStream_t stream) {
  const int64_t blocks = scene.images() * scene.blocks();
  if (blocks == 0) return;
  with_degree(scene.degree, [&](auto degree) {
    project_splats<decltype(degree)::value><<<unsigned(blocks), frame::kGaussianThreads, 0, stream>>>(scene, out, scratch);
  });
}

void count_visible(const Scene& scene, const Splats& splats, uint32_t* counts, cudaStream_t stream) {
  const int64_t blocks = scene.images() * scene.blocks();
  if (blocks > 0) count_visible_splats<<<unsigned(blocks), frame::kGaussianThreads, 0, stream>>>(scene, splats.radii, counts);
}

void pack(const Scene& scene, const Splats& splats, const int32_t* block_starts, const PackedSplats& out, cudaStream_t stream) {
  const int64_t blocks = scene.images() * scene.blocks();
  if (blocks > 0) pack_splats<<<unsigned(blocks), frame::kGaussianThreads, 0, stream>>>(scene, splats, block_starts, out);
}

void renumber(int64_t length, const int32_t* row_of, const int32_t* from, int32_t* to, cudaStream_t stream) {
  if (length > 0) renumber_splats<<<blocks_for(length), kThreads, 0, stream>>>(length, row_of, from, to);
}

}  // namespace gsplat::rasterization
