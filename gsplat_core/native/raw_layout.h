// The layout of a Gaussian's row of raw parameters: deformation deltas [N, 16] are added in it, and their gradient has it too.
// gsplat_core/scene/gaussians.py has the same numbers for Python; a test compares them.
#pragma once

constexpr int kRawColumns = 16;
constexpr int kRawPosition = 0;  // x, y, z
constexpr int kRawRotation = 3;  // quaternion: w, x, y, z
constexpr int kRawLogScale = 7;
constexpr int kRawColor = 10;    // red, green, blue of the first spherical-harmonics coefficient
constexpr int kRawOpacity = 13;  // logit
constexpr int kRawUsed = 14;     // columns from here on are unused and zero

// The basis-function field moves the columns in front of the opacity.
constexpr int kRawBasisChannels = kRawOpacity;

// The HexPlane field's network puts out position, log-scale, rotation and opacity, in this order.
constexpr int kHeadOutputs = 11;
// The network's output for a raw column, or -1 where it has none.
constexpr int head_output(int column) {
  if (column < kRawRotation) return column;
  if (column < kRawLogScale) return column - kRawRotation + 6;
  if (column < kRawColor) return column - kRawLogScale + 3;
  return column == kRawOpacity ? 10 : -1;
}
