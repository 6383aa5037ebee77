// One thread per Gaussian: deform, activate, project, colour, and count or emit its instances.
#include "dependent_launch.cuh"
#include "gaussian.cuh"
#include "instances.cuh"

namespace gsplat::frame {
namespace {

constexpr float kConstantBase = 0.28209479177387814f;

// A warp's shared memory: first the coefficients, later the (splat, tile) pairs of its small footprints.
template <int degree, class Coefficient>
union WarpShared {
  StagedHarmonics<degree, Coefficient> harmonics;
  uint32_t touched[kMaxSmallTiles];
};

__device__ inline float in_fixed_point(float channel) {
  return __int_as_float(__float2int_rn(fminf(channel, kMostChannel) * float(1 << kChannelBits)));
}

// Return the opacity of a Gaussian in a direction: a sum of harmonics of either sign, which may exceed 1.
__device__ inline float opacity_in(const Weighting& weighting, int64_t n, const float (&bases)[kOpacityBases]) {
  const float* const row = weighting.opacity_harmonics + kOpacityBases * n;
  float sum = 0;
  for (int k = 0; k < kOpacityBases; k += 4) {
    const float4 of = load_four(row + k, weighting.aligned);
    sum = fmaf(bases[k], of.x, fmaf(bases[k + 1], of.y, fmaf(bases[k + 2], of.z, fmaf(bases[k + 3], of.w, sum))));
  }
  return sum;
}

// One frame's Gaussians, of alpha blending or (`weighted`) of weighted sums.
template <int degree, class Coefficient, bool weighted>
__global__ void __launch_bounds__(kGaussianThreads, degree < 4 ? 8 : 5)
    preprocess_gaussians(Scene in, Weighting weighting, Lists lists, Scratch scratch) {
  allow_dependent_launch();
  __shared__ Camera camera;
  __shared__ WarpShared<degree, Coefficient> warps[kGaussianThreads / 32];
  const int64_t n = int64_t(blockIdx.x) * kGaussianThreads + threadIdx.x;
  const int lane = threadIdx.x & 31;
  WarpShared<degree, Coefficient>& shared = warps[threadIdx.x / 32];
  Record<4>* const records = static_cast<Record<4>*>(lists.records);
  const Coefficient* const sh = reinterpret_cast<const Coefficient*>(in.sh);

  RawGaussian g;
  g.usable = false;
  if (n < in.count) g = load_gaussian(in, n);
  load_camera(in, camera);
  Projected p;
  p.valid = 0;
  float opacity = 0, factor = 1;  // factor: of a weighted sum, for what the opacity exceeds 1, with its sign
  if (g.usable) {
    if constexpr (weighted) {
      float direction[3], bases[kOpacityBases];
      unit_direction(camera.center, g.mean, direction);
      bases_at<kOpacityDegree>(direction[0], direction[1], direction[2], bases);
      factor = opacity_in(weighting, n, bases);
      opacity = isfinite(factor) ? fminf(fabsf(factor), 1.0f) : 0.0f;
      factor = copysignf(fmaxf(fabsf(factor), 1.0f), factor);
    } else {
      opacity = opacity_of(g);
    }
    p = project(projection_input(in, camera), g.mean, geometry_of(g), &opacity, false);
  }
  const unsigned visible = __ballot_sync(kAll, p.valid);
  using Staged = StagedHarmonics<degree, Coefficient>;
  if constexpr (degree > 0)  // copies overlap with the computation of the boxes
    shared.harmonics.load(sh + (n - lane) * Staged::kUsed, Staged::kUsed, visible, in.aligned);

  Record<4> r = {};
  Footprint footprint = {0, 0};
  if (p.valid) {
    set_shape(r, p.u, p.v, p.conic, log2f(opacity));
    TileBox box = box_around(p.u, p.v, p.radius_x, p.radius_y, kTile, in.tile_width, in.tile_height);
    box.ellipse = ellipse_of_record(r.xyab, r.c, r.l);
    footprint = footprint_of(box);
  }
  if constexpr (degree > 0) Staged::wait();
  if (footprint.y != 0) {
    float color[3];
    for (int j = 0; j < 3; ++j) color[j] = fmaf(kConstantBase, g.color[j], 0.5f);
    if constexpr (degree > 0) {
      float direction[3], bases[kBasesOf<degree>];
      unit_direction(camera.center, g.mean, direction);
      bases_at<degree>(direction[0], direction[1], direction[2], bases);
      shared.harmonics.add_color(bases, color);
    } else {
      for (int j = 0; j < 3; ++j) color[j] = fmaf(kConstantBase, to_float(sh[3 * n + j]), color[j]);
    }
    if constexpr (weighted) factor *= fmaxf(1 - p.depth / *weighting.sigma, 0.0f) * weighting.factors[n];
    // 0 times a non-finite value is NaN. A splat with a weight of 0 adds nothing.
    if (0 * color[0] + 0 * color[1] + 0 * color[2] + 0 * factor == 0 && factor != 0) {
      for (int j = 0; j < 3; ++j) r.colors[j] = fmaxf(color[j], 0.0f);
      r.colors[3] = p.depth;
      if constexpr (weighted) {
        r.colors[3] /= *weighting.distance;
        for (int j = 0; j < 4; ++j) r.colors[j] = in_fixed_point(r.colors[j]);
        r.colors[4] = fminf(fmaxf(factor, -kMostTerm), kMostTerm);
      }
      records[n] = r;
    } else {
      footprint = {0, 0};
    }
  }
  const uint32_t depth = footprint.y != 0 ? __float_as_uint(p.depth) : 0;
  if (lists.segment > 0) {
    // In the mode with one segment per tile, keys can be written before the list lengths are known.
    if (n == 0)
      for (int i = 0; i < kStatusSize; ++i) lists.status[i] = 0;  // blend adds the counts of the tiles
    __syncwarp();                                                 // all records are written, and all coefficients are read
    emit_small<kSegments>(in, lists, scratch, footprint, n, depth, 0, shared.touched);
    emit_large<kSegments>(in, lists, scratch, footprint, n, depth, 0);
    return;
  }
  if (n < in.count) {
    scratch.footprints[n] = make_uint2(footprint.x, footprint.y);
    if (footprint.y != 0) scratch.depths[n] = depth;
  }
  const auto count = [&](int tile, int) { atomicAdd(scratch.counters + tile * scratch.counter_stride, 1u); };
  for_each_small_tile(footprint, in.tile_width, count);
  uint32_t tiles = uint32_t(footprint.small_count());
  __syncwarp();  // records of large footprints are visible to the warp
  for_each_large(footprint, [&](int owner) {
    const int of_large = for_each_large_tile(footprint, records, n, owner, in.tile_width, count);
    if (lane == owner) tiles = uint32_t(of_large);
  });
  if (scratch.block_counts == nullptr) return;
  __shared__ uint32_t warp_sums[32];
  const uint32_t sum = sum_over_block(tiles, warp_sums).all;
  if (threadIdx.x == 0) scratch.block_counts[blockIdx.x] = sum;
}

template <class Coefficient, bool weighted>
void preprocess_by_degree(const Scene& in, const Weighting& weighting, const Lists& lists, const Scratch& scratch,
                          cudaStream_t stream) {
  if (in.count == 0) return;
  constexpr decltype(&preprocess_gaussians<0, Coefficient, weighted>) by_degree[] = {
      preprocess_gaussians<0, Coefficient, weighted>, preprocess_gaussians<1, Coefficient, weighted>,
      preprocess_gaussians<2, Coefficient, weighted>, preprocess_gaussians<3, Coefficient, weighted>,
      preprocess_gaussians<4, Coefficient, weighted>};
  by_degree[in.sh_degree]<<<blocks_for(in.count, kGaussianThreads), kGaussianThreads, 0, stream>>>(in, weighting, lists, scratch);
}

}  // namespace

void preprocess(const Scene& in, const Lists& lists, const Scratch& scratch, cudaStream_t stream) {
  const auto run = in.half_sh ? preprocess_by_degree<__half, false> : preprocess_by_degree<float, false>;
  run(in, {}, lists, scratch, stream);
}

void preprocess_weighted(const Scene& in, const Weighting& weighting, const Lists& lists, const Scratch& scratch,
                         cudaStream_t stream) {
  preprocess_by_degree<float, true>(in, weighting, lists, scratch, stream);
}

}  // namespace gsplat::frame
