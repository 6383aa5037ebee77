// What the forward and the backward kernels share: splats ready to blend, the window of a block, and which splats reach a warp.
#pragma once

#include <type_traits>

#include "compositing_cuda.h"

namespace {

constexpr int kBlockThreads = 128;
constexpr int kWarps = kBlockThreads / 32;
constexpr int kQuadrant = 8;  // pixels on a side
constexpr int kPixelsEach = 2;
constexpr unsigned kAll = 0xffffffffu;

constexpr float kFaintest = -7.99435344f;  // log2(1/255): a splat fainter than this at a pixel is skipped there
constexpr float kOpaque = -0.01449957f;    // log2(0.99): the most opaque that a splat can be
constexpr float kStop = 1e-4f;             // a splat that would leave less transmittance ends the pixel, unblended
constexpr float kLn2 = 0.69314718f, kLog2E = 1.44269504f;

// log2(alpha) = a dx^2 + b dx dy + c dy^2 + l with dx, dy from the mean to the pixel. A splat with a value that is not finite has
// l = -infinity, so that it reaches no pixel. log2(alpha) beyond `cap` is skipped: l where the conic is indefinite (sigma would
// be negative), else infinity. With D > 0 its colours come along, in the rest of the last 16 bytes and on.
template <int D>
struct alignas(16) Record {
  float4 xyab;
  float c, l, cap;
  float colors[D <= 1 ? 1 : (D + 6) / 4 * 4 - 3];
};
static_assert(sizeof(Record<0>) == 32 && sizeof(Record<1>) == 32 && sizeof(Record<3>) == 48 && sizeof(Record<5>) == 48);

template <int D>
__device__ inline Record<D> faint_record() {
  Record<D> r = {};
  r.l = -INFINITY;
  return r;
}

template <int D>
__global__ void make_records(DeviceCompositing in, Record<D>* records) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.count) return;
  const float x = in.means2d[2 * i], y = in.means2d[2 * i + 1], opacity = in.opacities[i];
  const float a = in.conics[3 * i], b = in.conics[3 * i + 1], c = in.conics[3 * i + 2];
  Record<D> r = {};
  bool usable = isfinite(x) && isfinite(y) && isfinite(a) && isfinite(b) && isfinite(c) && isfinite(opacity);
  if constexpr (D > 0) {
    for (int d = 0; d < D; ++d) {
      r.colors[d] = in.colors[D * i + d];
      usable = usable && isfinite(r.colors[d]);
    }
  } else {
    for (int d = 0; d < in.channels; ++d) usable = usable && isfinite(in.colors[in.channels * i + d]);
  }
  if (!usable) {
    r = faint_record<D>();
  } else {
    r.xyab = make_float4(x, y, -0.5f * kLog2E * a, -kLog2E * b);
    r.c = -0.5f * kLog2E * c;
    r.l = opacity > 0 ? log2f(opacity) : -INFINITY;
    r.cap = a >= 0 && c >= 0 && a * c - b * b >= 0 ? INFINITY : r.l;
  }
  records[i] = r;
}

template <int D>
Record<D>* records_of(const DeviceCompositing& in, CudaScratch& scratch, cudaStream_t stream) {
  Record<D>* const records = scratch.array<Record<D>>(in.count);
  if (in.count > 0) make_records<D><<<blocks_for(in.count), kThreads, 0, stream>>>(in, records);
  return records;
}

// The lists come from the caller: an index that is no splat's is read as a splat that reaches no pixel.
template <int D>
__device__ inline Record<D> fetch(const DeviceCompositing& in, const Record<D>* records, int64_t position, int64_t end, int& id) {
  id = position >= 0 && position < end ? in.flatten_ids[position] : -1;
  return uint32_t(id) < uint64_t(in.count) ? records[id] : faint_record<D>();
}

// The window of this block: its instances, and where its warp and thread are.
struct Window {
  int64_t tile, image, begin, end;
  int quadrant_x, quadrant_y;  // first pixel of the warp's quadrant
  int x, y[kPixelsEach];       // this thread's pixels
  bool inside[kPixelsEach];

  __device__ explicit Window(const DeviceCompositing& in) {
    const int side = (in.tile_size + kWindowSize - 1) / kWindowSize, windows = side * side;
    const int64_t tiles = int64_t(in.tile_width) * in.tile_height;
    tile = blockIdx.x / windows;
    image = tile / tiles;
    begin = clamp(in.offsets[tile], in.instances);
    end = tile + 1 < tiles * in.images ? clamp(in.offsets[tile + 1], in.instances) : in.instances;
    const int part = int(blockIdx.x % windows), within = int(tile % tiles), lane = threadIdx.x & 31, warp = threadIdx.x / 32;
    const int tile_x = within % in.tile_width * in.tile_size, tile_y = within / in.tile_width * in.tile_size;
    const int right = min(tile_x + in.tile_size, in.width), bottom = min(tile_y + in.tile_size, in.height);
    quadrant_x = tile_x + part % side * kWindowSize + warp % 2 * kQuadrant;
    quadrant_y = tile_y + part / side * kWindowSize + warp / 2 * kQuadrant;
    x = quadrant_x + lane % kQuadrant;
    for (int p = 0; p < kPixelsEach; ++p) {
      y[p] = quadrant_y + lane / kQuadrant + p * (kQuadrant / kPixelsEach);
      inside[p] = x < right && y[p] < bottom;
    }
  }
  __device__ static int64_t clamp(int64_t value, int64_t most) { return value < 0 ? 0 : value > most ? most : value; }
  __device__ int64_t pixel(const DeviceCompositing& in, int p) const { return (image * in.height + y[p]) * in.width + x; }
};

struct Falloff {
  float dx, dy, power;  // log2(alpha) before the cut-offs
};
template <int D>
__device__ inline Falloff falloff(const Record<D>& r, float x, float y) {
  const float dx = x - r.xyab.x, dy = y - r.xyab.y;
  return {dx, dy, fmaf(fmaf(r.xyab.w, dy, dx * r.xyab.z), dx, fmaf(dy * r.c, dy, r.l))};
}

__device__ inline float exp2_fast(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ inline float reciprocal(float x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

// Whether the contour alpha = 1/255 may reach a pixel centre of the quadrant whose first centre is (x, y). Its part in the
// quadrant's rows reaches in x from the left to the right solution of a dx^2 + 2 b dx dy + c dy^2 = k at the dy of those rows
// that is nearest to the outermost point; never less than that, for a splat left out would be missing in the image.
template <int D>
__device__ inline bool reaches(const Record<D>& r, float x, float y) {
  const float k = r.l + (2e-3f - kFaintest);  // a little outside of the contour, against rounding
  if (!(k >= 0)) return false;
  const float a = -r.xyab.z, b = -0.5f * r.xyab.w, c = -r.c, ux = r.xyab.x - x, uy = r.xyab.y - y;
  const float ac = a * c, det = fmaf(-b, b, ac) - ac * 5e-7f;
  const float top = -b * sqrtf(k / (c * det));
  if (!(a > 0 && c > 0 && det > ac * 1e-6f && fabsf(top) <= 1e30f)) return true;  // no proper ellipse: pixel by pixel
  const float inverse = 1.0f / a, slope = -b * inverse, offset = k * inverse, curve = det * inverse * inverse;
  const float low = -uy, high = low + float(kQuadrant - 1);
  const float at_right = fminf(fmaxf(top, low), high), at_left = fminf(fmaxf(-top, low), high);
  const float right_square = fmaf(-curve * at_right, at_right, offset), left_square = fmaf(-curve * at_left, at_left, offset);
  if (!(fminf(right_square, left_square) >= 0)) return false;
  const float right = fmaf(slope, at_right, ux) + sqrtf(right_square) + 2e-3f;
  const float left = fmaf(slope, at_left, ux) - sqrtf(left_square) - 2e-3f;
  return right >= 0 && left <= float(kQuadrant - 1);
}

// run(Compiled number of channels): 0 stands for any other number.
template <class Run>
void with_channels(int channels, const Run& run) {
  switch (channels) {
    case 1: return run(std::integral_constant<int, 1>());
    case 3: return run(std::integral_constant<int, 3>());
    case 4: return run(std::integral_constant<int, 4>());
    case 5: return run(std::integral_constant<int, 5>());
    default: return run(std::integral_constant<int, 0>());
  }
}

}  // namespace
