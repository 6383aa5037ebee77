// Constants of projection and blending shared by the kernels of both devices and by Python, with the values of gsplat
// 1.6. The unfused ops take the maximum alpha and the compensation floor as arguments, to support gsplat 1.5.3 (0.999
// and 0). tests/gsplat_core/test_constants.py compares the values with Python's.
#pragma once

namespace gsplat {

constexpr float kMaxAlpha = 0.99f;  // upper bound of a splat's alpha at a pixel
constexpr float kLog2MaxAlpha = -0.01449957f;
constexpr float kAlphaCutoff = 1.0f / 255.0f;  // a splat with a smaller alpha is skipped at that pixel
constexpr float kLog2AlphaCutoff = -7.99435344f;
constexpr float kMinTransmittance = 1e-4f;    // blending stops before the splat that would reduce transmittance below this
constexpr float kCompensationFloor = 0.005f;  // lower bound of the opacity compensation for the 2D blur
constexpr float kMaxExtentSigmas = 3.33f;     // at this distance alpha of an opaque Gaussian falls below kAlphaCutoff
constexpr float kMaxRadiusPx = 1e9f;          // fits in an int32
constexpr float kFieldOfViewMargin = 0.3f;    // in half fields of view; the pinhole Jacobian is clamped outside
constexpr int kTileSize = 16;                 // px

// Upper bound of alpha and its logarithm, for calls that replace kMaxAlpha by another bound.
struct AlphaLimit {
  float most = kMaxAlpha, log2_most = kLog2MaxAlpha;
};

}  // namespace gsplat
