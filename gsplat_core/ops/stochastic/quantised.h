// Decoding of quantised splats: 16 bytes of geometry and colour, relative to the ranges of a chunk of kChunk splats.
//
// Bits of the four words, from the lowest: position 3 x 16, log-scales 3 x 8, rotation 2 + 3 x 10 (index of the largest
// component and the others), opacity 8, colour 5 + 6 + 5. The colour is stored as (green - red) / 2, the mean, and
// blue / 2 - (red + green) / 4, because the colours of neighbours mostly differ in brightness; its ranges belong to
// kColourChunk splats. rendering/stochastic.py writes them.
#pragma once

#include "simd.h"
#include "stochastic.h"

namespace GSPLAT_ISA::stochastic {

using namespace gsplat::stochastic;

// Offsets of a chunk's ranges: minimum and step.
enum ChunkRange { kPosition = 0, kLogScale = 6, kBands = 12, kColour = 20 };

struct Decoded {
  float mean[3], quat[4], log_scales[3], opacity;
};

GSPLAT_INLINE float square_root_of(float x) {
#if defined(__CUDACC__)
  return sqrtf(x);
#else
  return __builtin_sqrtf(x);
#endif
}

GSPLAT_INLINE void decode_mean(const Scene& scene, int64_t row, float mean[3]) {
  const uint32_t* words = scene.packed + 4 * row;
  const float* chunk = scene.chunks + row / kChunk * kChunkFloats;
  const uint32_t steps[3] = {words[0] & 0xffff, words[0] >> 16, words[1] & 0xffff};
  for (int k = 0; k < 3; ++k) mean[k] = chunk[kPosition + k] + chunk[kPosition + 3 + k] * float(steps[k]);
}

GSPLAT_INLINE float decode_opacity(const Scene& scene, int64_t row) {
  return float((scene.packed[4 * row + 3] >> 8) & 0xff) * (1.0f / 255.0f);
}

GSPLAT_INLINE Decoded decode(const Scene& scene, int64_t row) {
  const uint32_t* words = scene.packed + 4 * row;
  const float* chunk = scene.chunks + row / kChunk * kChunkFloats;
  Decoded d;
  decode_mean(scene, row, d.mean);
  d.opacity = decode_opacity(scene, row);
  const uint32_t scales[3] = {(words[1] >> 16) & 0xff, words[1] >> 24, words[3] & 0xff};
  for (int k = 0; k < 3; ++k) d.log_scales[k] = chunk[kLogScale + k] + chunk[kLogScale + 3 + k] * float(scales[k]);
  const uint32_t largest = words[2] & 3;
  float left = 1, others[3];
  for (int k = 0; k < 3; ++k) {
    others[k] = (float((words[2] >> (2 + 10 * k)) & 0x3ff) * (2.0f / 1022.0f) - 1.0f) * 0.70710678f;
    left -= others[k] * others[k];
  }
  const float most = square_root_of(left > 0 ? left : 0);
  for (uint32_t k = 0, n = 0; k < 4; ++k) d.quat[k] = k == largest ? most : others[n++];
  return d;
}

// Write the coefficients [bases, 3] of row `row`.
GSPLAT_INLINE void decode_sh(const Scene& scene, int64_t row, float* sh) {
  const float* chunk = scene.chunks + row / kChunk * kChunkFloats;
  const uint32_t colour = scene.packed[4 * row + 3] >> 16;
  const uint32_t steps[3] = {colour & 31, (colour >> 5) & 63, colour >> 11};
  const float* range = chunk + kColour + 6 * (row % kChunk / kColourChunk);
  float c[3];
  for (int k = 0; k < 3; ++k) c[k] = range[k] + range[3 + k] * float(steps[k]);
  const float grey = c[1] - c[2] * (2.0f / 3.0f);
  sh[0] = grey - c[0];
  sh[1] = grey + c[0];
  sh[2] = c[1] + c[2] * (4.0f / 3.0f);
  const uint8_t* rest = scene.packed_sh + row * (scene.bases - 1) * 3;
  for (int n = 1; n < scene.bases; ++n) {
    const int band = n < 4 ? 0 : n < 9 ? 1 : n < 16 ? 2 : 3;
    const float* of_band = chunk + kBands + 2 * band;
    for (int k = 0; k < 3; ++k) sh[3 * n + k] = of_band[0] + of_band[1] * float(rest[3 * (n - 1) + k]);
  }
}

}  // namespace GSPLAT_ISA::stochastic
