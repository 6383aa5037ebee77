// A splat ready to blend, and the constants of blending.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>

namespace {

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

}  // namespace
