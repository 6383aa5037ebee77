#include <cuda_fp16.h>

#include "../spherical_harmonics/spherical_harmonics_bases.h"
#include "frame_emit.cuh"
#include "frame_gaussian.cuh"
#include "frame_launch.cuh"

using namespace GSPLAT_ISA;
using namespace GSPLAT_ISA::spherical_harmonics;

namespace {

template <int bytes>
__device__ inline void copy_async(void* to, const void* from) {
  const unsigned at = unsigned(__cvta_generic_to_shared(to));
  if constexpr (bytes == 16) {
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(at), "l"(from));
  } else {
    asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" ::"r"(at), "l"(from));
  }
}

__device__ inline float to_float(float x) { return x; }
__device__ inline float to_float(__half x) { return __half2float(x); }

// Coefficients of 32 Gaussians in shared memory. A Gaussian's row is an odd number of 16 bytes apart from the next, so that eight
// lanes reading theirs meet in no bank.
template <int degree, class Coefficient>
struct StagedHarmonics {
  static constexpr int kBases = (degree + 1) * (degree + 1), kRow = 3 * kBases, kInQuad = 16 / sizeof(Coefficient);
  static constexpr int kQuads = (kRow + kInQuad - 1) / kInQuad, kStride = kInQuad * (kQuads | 1);
  uint4 rows[32 * kStride / kInQuad];

  // By a warp, those of the Gaussians in `shown` alone: what is culled is not read. They are there after `wait`.
  __device__ void load(const Coefficient* from, unsigned shown, bool aligned) {
    const int lane = threadIdx.x & 31;
    Coefficient* const to = reinterpret_cast<Coefficient*>(rows);
    if (kRow % kInQuad == 0 && aligned) {
#pragma unroll 4
      for (int i = lane; i < 32 * kQuads; i += 32) {
        const int row = i / kQuads;
        if (shown >> row & 1) copy_async<16>(to + row * kStride + kInQuad * (i % kQuads), from + kInQuad * i);
      }
    } else {
#pragma unroll 4
      for (int i = lane; i < 32 * kRow; i += 32) {
        const int row = i / kRow;
        if (!(shown >> row & 1)) continue;
        if constexpr (sizeof(Coefficient) == 4) {
          copy_async<4>(to + row * kStride + i % kRow, from + i);
        } else {
          to[row * kStride + i % kRow] = from[i];
        }
      }
    }
  }

  __device__ static void wait() {
    asm volatile("cp.async.wait_all;" ::: "memory");
    __syncwarp();
  }

  __device__ void color_at(const float direction[3], float color[3]) const {
    float bases[kBases], values[kInQuad * kQuads];
    bases_at<degree>(direction[0], direction[1], direction[2], bases);
    const uint4* const row = rows + (threadIdx.x & 31) * (kStride / kInQuad);
#pragma unroll
    for (int i = 0; i < kQuads; ++i) {
      const uint4 quad = row[i];
      Coefficient of_quad[kInQuad];
      memcpy(of_quad, &quad, sizeof(quad));
#pragma unroll
      for (int j = 0; j < kInQuad; ++j) values[kInQuad * i + j] = to_float(of_quad[j]);
    }
#pragma unroll
    for (int k = 0; k < kBases; ++k)
      for (int j = 0; j < 3; ++j) color[j] = fmaf(bases[k], values[3 * k + j], color[j]);
  }
};

__device__ inline Projected project_with(const FrameScene& in, const ProjectionInput& settings, const float mean[3],
                                         const Geometry& geometry, float opacity) {
  switch (in.camera_model) {
    case kOrtho: return project(settings, View<kOrtho>(settings), mean, geometry, &opacity, false);
    case kFisheye: return project(settings, View<kFisheye>(settings), mean, geometry, &opacity, false);
    default: return project(settings, View<kPinhole>(settings), mean, geometry, &opacity, false);
  }
}

constexpr float kConstantBase = 0.28209479177387814f;

// A warp's shared memory: the coefficients, and once the colours are known what its small splats touch.
template <int degree, class Coefficient>
union WarpRoom {
  StagedHarmonics<degree, Coefficient> harmonics;
  uint32_t touched[kMostSmall];
};

template <int degree, class Coefficient>
__global__ void __launch_bounds__(kFrameThreads, degree < 4 ? 8 : 5)
    preprocess(FrameScene in, FrameLists lists, FrameScratch scratch) {
  let_kernel_behind_come();
  __shared__ FrameCamera camera;
  __shared__ WarpRoom<degree, Coefficient> rooms[kFrameThreads / 32];
  const int64_t n = int64_t(blockIdx.x) * kFrameThreads + threadIdx.x;
  const int lane = threadIdx.x & 31;
  WarpRoom<degree, Coefficient>& room = rooms[threadIdx.x / 32];
  Record<4>* const records = static_cast<Record<4>*>(lists.records);
  const Coefficient* const sh = reinterpret_cast<const Coefficient*>(in.sh);

  RawGaussian g;
  g.usable = false;
  if (n < in.count) g = load_gaussian(in, n);
  load_camera(in, camera);
  Projected p;
  p.valid = 0;
  float opacity = 0;
  if (g.usable) {
    opacity = opacity_of(g);
    p = project_with(in, projection_input(in, camera), g.mean, geometry_of(g), opacity);
  }
  const unsigned shown = __ballot_sync(kAll, p.valid);
  if constexpr (degree > 0)
    room.harmonics.load(sh + (n - lane) * StagedHarmonics<degree, Coefficient>::kRow, shown,
                        in.aligned);  // on their way meanwhile

  Record<4> r = {};
  Footprint footprint = {0, 0};
  if (p.valid) {
    r.xyab = make_float4(p.u, p.v, -0.5f * kLog2E * p.conic[0], -kLog2E * p.conic[1]);
    r.c = -0.5f * kLog2E * p.conic[2];
    r.l = log2f(opacity);
    r.cap = INFINITY;  // the conic is definite
    TileBox box = box_around(p.u, p.v, p.radius_x, p.radius_y, kFrameTile, in.tile_width, in.tile_height);
    box.ellipse = ellipse_of_record(r.xyab, r.c, r.l);
    footprint = footprint_of(box);
  }
  if constexpr (degree > 0) StagedHarmonics<degree, Coefficient>::wait();
  if (footprint.y != 0) {
    float color[3], direction[3];
    for (int j = 0; j < 3; ++j) color[j] = fmaf(kConstantBase, g.color[j], 0.5f);
    if constexpr (degree > 0) {
      unit_direction(camera, g.mean, direction);
      room.harmonics.color_at(direction, color);
    } else {
      for (int j = 0; j < 3; ++j) color[j] = fmaf(kConstantBase, to_float(sh[3 * n + j]), color[j]);
    }
    if (0 * color[0] + 0 * color[1] + 0 * color[2] == 0) {
      for (int j = 0; j < 3; ++j) r.colors[j] = fmaxf(color[j], 0.0f);
      r.colors[3] = p.depth;
      records[n] = r;
    } else {
      footprint = {0, 0};
    }
  }
  const uint32_t depth = footprint.y != 0 ? __float_as_uint(p.depth) : 0;
  if (lists.tile_capacity > 0) {
    // Every tile has a room of its own: the lists can be written before their lengths are known.
    if (n == 0)
      for (int i = 0; i < kStatusWords; ++i) lists.status[i] = 0;  // to which the tiles will add
    __syncwarp();                                                  // the records are written, the coefficients read
    put_small<kPerTile>(in, lists, scratch, footprint, n, depth, 0, room.touched);
    put_large<kPerTile>(in, lists, scratch, footprint, n, depth, 0);
    return;
  }
  if (n < in.count) {
    scratch.footprints[n] = make_uint2(footprint.x, footprint.y);
    if (footprint.y != 0) scratch.depths[n] = depth;
  }
  const auto count = [&](int tile, int) { atomicAdd(scratch.slots + tile * scratch.slot_stride, 1u); };
  for_small_tiles(footprint, in.tile_width, count);
  uint32_t tiles = uint32_t(footprint.small_count());
  __syncwarp();  // the records of large footprints are written
  for_large_owners(footprint, [&](int owner) {
    const int of_large = for_large_tiles(footprint, records, n, owner, in.tile_width, count);
    if (lane == owner) tiles = uint32_t(of_large);
  });
  if (scratch.sums == nullptr) return;
  __shared__ uint32_t of_warps[32];
  const uint32_t sum = sum_over_block(tiles, of_warps).all;
  if (threadIdx.x == 0) scratch.sums[blockIdx.x] = sum;
}

template <class Coefficient>
void preprocess_by_degree(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch, cudaStream_t stream) {
  constexpr decltype(&preprocess<0, Coefficient>) by_degree[] = {preprocess<0, Coefficient>, preprocess<1, Coefficient>,
                                                                 preprocess<2, Coefficient>, preprocess<3, Coefficient>,
                                                                 preprocess<4, Coefficient>};
  by_degree[in.sh_degree]<<<blocks_for(in.count, kFrameThreads), kFrameThreads, 0, stream>>>(in, lists, scratch);
}

}  // namespace

void preprocess_frame(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch, cudaStream_t stream) {
  if (in.count == 0) return;
  const auto run = in.half_sh ? preprocess_by_degree<__half> : preprocess_by_degree<float>;
  run(in, lists, scratch, stream);
}
