// Blending of flow in windows of 16x16 pixels, as in compositing: four warps with a quadrant of 8x8 pixels each. The
// gradient rows of the instances are summed per splat in list order, without atomics.
#include "../compositing/gather_rows.cuh"
#include "../compositing/warp_sums.cuh"
#include "flow_blending_math.h"

namespace gsplat::flow_blending {
namespace {

using namespace blending;
using compositing::Place;
using compositing::record_at;
using compositing::warp_sums;
using GSPLAT_ISA::flow_blending::Moved;
using GSPLAT_ISA::flow_blending::moved;
using GSPLAT_ISA::flow_blending::moved_backward;
using GSPLAT_ISA::flow_blending::Ray;

// Return the ray through the centre of a pixel.
__device__ inline Ray ray_of(const Pinhole& camera, const Record<0>& r, int x, int y) {
  const float at_x = float(x) + 0.5f, at_y = float(y) + 0.5f;
  return {at_x - r.xyab.x, at_y - r.xyab.y, (at_x - camera.cx) * (1.0f / camera.fx), (at_y - camera.cy) * (1.0f / camera.fy)};
}

// Make splats with a non-finite ray or plane reach no pixel.
__global__ void mute_unusable(Inputs in, Record<0>* records) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.count) return;
  float zero = 0;
  for (int k = 0; k < kRayNumbers; ++k) zero += 0 * in.rays[i * kRayNumbers + k];
  for (int k = 0; k < kPlaneNumbers; ++k) zero += 0 * in.planes[i * kPlaneNumbers + k];
  if (!(zero == 0)) records[i] = faint_record<0>();
}

Record<0>* usable_records(const Inputs& in, CudaScratch& scratch, cudaStream_t stream) {
  Record<0>* const records = compositing::records_of<0>(in, scratch, stream);
  if (in.count > 0) mute_unusable<<<blocks_for(in.count), kThreads, 0, stream>>>(in, records);
  return records;
}

// Splats of a batch in shared memory, one per thread.
struct Stage {
  Record<0> records[kBlockThreads];
  float rays[kBlockThreads][kRayNumbers];
  float planes[kBlockThreads][kPlaneNumbers];

  __device__ void load(const Inputs& in, const Record<0>* of, int position, bool has) {
    const int i = int(threadIdx.x);
    records[i] = has ? record_at(in, of, position) : faint_record<0>();
    if (!has || !(records[i].l > -INFINITY)) return;
    const int64_t id = in.flatten_ids[position];
    for (int k = 0; k < kRayNumbers; ++k) rays[i][k] = in.rays[id * kRayNumbers + k];
    for (int k = 0; k < kPlaneNumbers; ++k) planes[i][k] = in.planes[id * kPlaneNumbers + k];
  }
};

// Transmittance of a thread's pixels, and the weight of one splat in them.
struct Pixels {
  float through[kPixelsEach];
  bool open[kPixelsEach];

  __device__ explicit Pixels(const Window& w) {
    for (int p = 0; p < kPixelsEach; ++p) through[p] = 1, open[p] = w.inside[p];
  }
  __device__ bool any() const { return open[0] || open[1]; }
  __device__ float weight(int p, const Record<0>& r, float x, float y, const AlphaLimit& limit) {
    const float power = falloff(r, x, y).power;
    if (!(open[p] && power >= kLog2AlphaCutoff && power <= r.cap)) return 0;
    const float alpha = exp2_fast(fminf(power, limit.log2_most)), behind = fmaf(-alpha, through[p], through[p]);
    if (!(behind > kMinTransmittance)) {
      open[p] = false;
      return 0;
    }
    const float weight = alpha * through[p];
    through[p] = behind;
    return weight;
  }
};

__global__ void __launch_bounds__(kBlockThreads) blend_windows(Inputs in, const Record<0>* records, float4* out) {
  __shared__ Stage stage;
  const Place place(in);
  const Window w = place.window(in);
  const int lane = threadIdx.x & 31;
  Pixels pixels(w);
  float4 sums[kPixelsEach] = {};
  for (int left = w.end - w.begin; left > 0; left -= kBlockThreads) {
    if (!__syncthreads_or(pixels.any())) break;
    stage.load(in, records, w.end - left + int(threadIdx.x), int(threadIdx.x) < left);
    __syncthreads();
    for (int group = 0; group < kBlockThreads && __any_sync(kAll, pixels.any()); group += 32) {
      unsigned hits =
          __ballot_sync(kAll, reaches(stage.records[group + lane], float(w.quadrant_x) + 0.5f, float(w.quadrant_y) + 0.5f));
      for (; hits != 0; hits &= hits - 1) {
        const int i = group + __ffs(int(hits)) - 1;
        for (int p = 0; p < kPixelsEach; ++p) {
          const float weight = pixels.weight(p, stage.records[i], float(w.x) + 0.5f, float(w.y[p]) + 0.5f, in.alpha);
          if (weight <= 0) continue;
          const Ray ray = ray_of(in.before, stage.records[i], w.x, w.y[p]);
          const Moved m = moved(stage.rays[i], stage.planes[i], in.before, in.after, ray);
          if (!m.in_front) continue;
          sums[p].x = fmaf(weight, m.flow_x, sums[p].x);
          sums[p].y = fmaf(weight, m.flow_y, sums[p].y);
          sums[p].z = fmaf(weight, m.p[2], sums[p].z);
          sums[p].w += weight;
        }
      }
    }
  }
  for (int p = 0; p < kPixelsEach; ++p)
    if (w.inside[p]) out[place.pixel(in, w, p)] = sums[p];
}

// Write the gradient row of every instance of the window; `rows` must be zeroed, for the instances behind the last
// open pixel.
__global__ void __launch_bounds__(kBlockThreads)
    backward_windows(Inputs in, const Record<0>* records, const float4* v_out, float* rows) {
  __shared__ Stage stage;
  __shared__ float sums[kWarps][kBlockThreads][kPlaneNumbers];
  const Place place(in);
  const Window w = place.window(in);
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32;
  Pixels pixels(w);
  float v[kPixelsEach][3];
  for (int p = 0; p < kPixelsEach; ++p) {
    const float4 given = w.inside[p] ? v_out[place.pixel(in, w, p)] : make_float4(0, 0, 0, 0);
    v[p][0] = given.x, v[p][1] = given.y, v[p][2] = given.z;
  }
  for (int left = w.end - w.begin; left > 0; left -= kBlockThreads) {
    if (!__syncthreads_or(pixels.any())) break;
    stage.load(in, records, w.end - left + int(threadIdx.x), int(threadIdx.x) < left);
    for (int i = lane; i < kBlockThreads; i += 32)
      for (int k = 0; k < kPlaneNumbers; ++k) sums[warp][i][k] = 0;
    __syncthreads();
    for (int group = 0; group < kBlockThreads && __any_sync(kAll, pixels.any()); group += 32) {
      unsigned hits =
          __ballot_sync(kAll, reaches(stage.records[group + lane], float(w.quadrant_x) + 0.5f, float(w.quadrant_y) + 0.5f));
      for (; hits != 0; hits &= hits - 1) {
        const int i = group + __ffs(int(hits)) - 1;
        float terms[16] = {};
        bool adds = false;
        for (int p = 0; p < kPixelsEach; ++p) {
          const float weight = pixels.weight(p, stage.records[i], float(w.x) + 0.5f, float(w.y[p]) + 0.5f, in.alpha);
          if (weight <= 0) continue;
          const Ray ray = ray_of(in.before, stage.records[i], w.x, w.y[p]);
          const Moved m = moved(stage.rays[i], stage.planes[i], in.before, in.after, ray);
          if (!m.in_front) continue;
          float v_p[3];
          moved_backward(m, in.after, weight, v[p], v_p);
#pragma unroll
          for (int k = 0; k < 3; ++k) {
            const float along = v_p[k] * m.depth_on_ray;
            terms[k] += v_p[k];
            terms[3 + 3 * k] = fmaf(along, ray.x, terms[3 + 3 * k]);
            terms[4 + 3 * k] = fmaf(along, ray.y, terms[4 + 3 * k]);
            terms[5 + 3 * k] += along;
          }
          adds = true;
        }
        if (!__any_sync(kAll, adds)) continue;
        const float sum = warp_sums<8>(terms, lane);
        if (lane % 2 == 0 && lane / 2 < kPlaneNumbers) sums[warp][i][lane / 2] = sum;
      }
    }
    __syncthreads();
    const int staged = min(left, kBlockThreads);
    float* const to = rows + int64_t(w.end - left) * kPlaneNumbers;
    for (int i = int(threadIdx.x); i < staged * kPlaneNumbers; i += kBlockThreads) {
      float sum = 0;
      for (int other = 0; other < kWarps; ++other) sum += (&sums[other][0][0])[i];
      to[i] = sum;
    }
  }
}

// Sum the rows of each splat in list order; a thread has one quarter of a row.
__global__ void sum_rows(int64_t count, const uint32_t* positions, const uint2* ranges, const float4* rows, float4* v_planes) {
  constexpr int kQuads = kPlaneNumbers / 4;
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= count * kQuads) return;
  const uint2 range = ranges[i / kQuads];
  float4 sum = make_float4(0, 0, 0, 0);
  for (uint32_t at = range.x; at < range.y; ++at)
    sum = compositing::plus(sum, rows[int64_t(positions[at]) * kQuads + i % kQuads]);
  v_planes[i] = sum;
}

}  // namespace

void blend_on_device(const Inputs& in, float* out, CudaScratch& scratch, cudaStream_t stream) {
  if (in.tiles() == 0) return;
  const Record<0>* const records = usable_records(in, scratch, stream);
  blend_windows<<<unsigned(in.tiles()), kBlockThreads, 0, stream>>>(in, records, reinterpret_cast<float4*>(out));
}

void blend_backward_on_device(const Inputs& in, const float* v_out, float* v_planes, CudaScratch& scratch, cudaStream_t stream) {
  if (in.count == 0) return;
  float4* const rows = scratch.array<float4>(in.instances * kPlaneNumbers / 4);
  check_cuda(cudaMemsetAsync(rows, 0, size_t(in.instances) * kPlaneNumbers * sizeof(float), stream), "clearing gradient rows");
  if (in.tiles() > 0) {
    const Record<0>* const records = usable_records(in, scratch, stream);
    backward_windows<<<unsigned(in.tiles()), kBlockThreads, 0, stream>>>(in, records, reinterpret_cast<const float4*>(v_out),
                                                                         reinterpret_cast<float*>(rows));
  }
  const compositing::Instances instances = compositing::by_splat(in, scratch, stream);
  sum_rows<<<blocks_for(in.count * (kPlaneNumbers / 4)), kThreads, 0, stream>>>(in.count, instances.positions, instances.ranges,
                                                                                rows, reinterpret_cast<float4*>(v_planes));
}

}  // namespace gsplat::flow_blending
