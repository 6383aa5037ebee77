// Constants of projection and blending that the kernels of both devices and the Python side share, as gsplat 1.6 has them; the
// plain ops take another maximum of alpha and another floor of the compensation as arguments (gsplat 1.5.3: 0.999 and 0).
// tests/gsplat_core/test_constants.py compares them with Python's.
#pragma once

namespace gsplat {

constexpr float kMaxAlpha = 0.99f;  // the most opaque that a splat can be at a pixel
constexpr float kLog2MaxAlpha = -0.01449957f;
constexpr float kAlphaCutoff = 1.0f / 255.0f;  // a splat that is fainter at a pixel is skipped there
constexpr float kLog2AlphaCutoff = -7.99435344f;
constexpr float kMinTransmittance = 1e-4f;    // a splat that would leave less ends the pixel, and is not blended
constexpr float kCompensationFloor = 0.005f;  // of the opacity's compensation for the blur
constexpr float kMaxExtentSigmas = 3.33f;     // beyond it an opaque Gaussian is below the cut-off
constexpr float kMaxRadiusPx = 1e9f;          // fits an int32
constexpr float kFieldOfViewMargin = 0.3f;    // in half fields of view: beyond it the pinhole's Jacobian is clamped
constexpr int kTileSize = 16;                 // px

// The most opaque that a splat can be at a pixel, where it may be another than kMaxAlpha.
struct AlphaLimit {
  float most = kMaxAlpha, log2_most = kLog2MaxAlpha;
};

}  // namespace gsplat
