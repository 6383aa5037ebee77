// Path of surface points through the optical flow of several images: one thread per point.
#include "cuda_scratch.h"
#include "surface_motion.h"

namespace gsplat::surface_motion {
namespace {

struct Seen {
  float depth, x, y;  // depth in front of the camera, pixel
  bool inside;        // inside of the image and in front of the camera
};

__device__ __forceinline__ Seen seen_by(const View& view, const float* p) {
  const float* const r = view.rotation;
  float local[3];
  for (int i = 0; i < 3; ++i) local[i] = r[3 * i] * p[0] + r[3 * i + 1] * p[1] + r[3 * i + 2] * p[2] + view.translation[i];
  Seen s;
  s.depth = fmaxf(local[2], kNearest);
  s.x = local[0] / s.depth * view.fx + view.cx;
  s.y = local[1] / s.depth * view.fy + view.cy;
  s.inside = s.x >= 0 && s.y >= 0 && s.x <= view.width && s.y <= view.height && local[2] > kNearest;
  return s;
}

// Sample the flow [height, width, 2] of an image at a pixel, bilinearly between cell centres, clamped to the edge.
__device__ __forceinline__ float2 flow_at(const float* cells, int64_t height, int64_t width, const View& image, float px,
                                          float py) {
  const float x = fminf(fmaxf(px * (float(width) / image.width) - 0.5f, 0.0f), float(width - 1));
  const float y = fminf(fmaxf(py * (float(height) / image.height) - 0.5f, 0.0f), float(height - 1));
  const int64_t column = int64_t(x), row = int64_t(y);
  const float right = x - float(column), down = y - float(row);
  const int64_t next = column + 1 < width ? 1 : 0, below = row + 1 < height ? width : 0;
  const float2* const cell = reinterpret_cast<const float2*>(cells) + row * width + column;
  const float2 a = cell[0], b = cell[next], c = cell[below], d = cell[below + next];
  const float ux = a.x + right * (b.x - a.x), uy = a.y + right * (b.y - a.y);
  const float lx = c.x + right * (d.x - c.x), ly = c.y + right * (d.y - c.y);
  return {ux + down * (lx - ux), uy + down * (ly - uy)};
}

__global__ void __launch_bounds__(kThreads)
    path(Flows flows, const float* __restrict__ points, float* __restrict__ positions, int64_t count) {
  const int64_t point = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (point >= count) return;
  const int64_t cells = 2 * flows.height * flows.width;
  float at[3] = {points[3 * point], points[3 * point + 1], points[3 * point + 2]};
  View before = view_of(flows.views);
  for (int64_t step = 0; step < flows.steps; ++step) {
    const View after = view_of(flows.views + (step + 1) * kViewNumbers);
    const Seen seen = seen_by(before, at), later = seen_by(after, at);
    if (seen.inside) {
      const float2 moved = flow_at(flows.cells + step * cells, flows.height, flows.width, after, seen.x, seen.y);
      const float x = (seen.x + moved.x - later.x) * later.depth / after.fx,
                  y = (seen.y + moved.y - later.y) * later.depth / after.fy;
      for (int i = 0; i < 3; ++i) at[i] += x * after.rotation[i] + y * after.rotation[3 + i];
    }
    for (int i = 0; i < 3; ++i) positions[(point * flows.steps + step) * 3 + i] = at[i];
    before = after;
  }
}

}  // namespace

void path_on_device(const Flows& flows, const float* points, float* positions, int64_t count, cudaStream_t stream) {
  path<<<blocks_for(count), kThreads, 0, stream>>>(flows, points, positions, count);
}

}  // namespace gsplat::surface_motion
