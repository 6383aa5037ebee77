// Column layout of a Gaussian's raw parameters in deformation deltas [N, 16] and their gradients.
// gsplat_core/scene/gaussians.py defines the same numbers for Python; a test compares them.
#pragma once

constexpr int kRawColumns = 16;
constexpr int kRawPosition = 0;  // x, y, z
constexpr int kRawRotation = 3;  // quaternion: w, x, y, z
constexpr int kRawLogScale = 7;
constexpr int kRawColor = 10;    // red, green, blue of the first spherical-harmonics coefficient
constexpr int kRawOpacity = 13;  // logit
constexpr int kRawUsed = 14;     // later columns are unused and zero

// Number of columns that the basis-function field changes: all before the opacity.
constexpr int kRawBasisChannels = kRawOpacity;

// Outputs of the HexPlane field's network, in the order position, log-scale, rotation, opacity.
constexpr int kHeadOutputs = 11;
// Return the network output of a raw column, or -1 for a column without one.
constexpr int head_output(int column) {
  if (column < kRawRotation) return column;
  if (column < kRawLogScale) return column - kRawRotation + 6;
  if (column < kRawColor) return column - kRawLogScale + 3;
  return column == kRawOpacity ? 10 : -1;
}
