// A launch with a team of lanes per point: 4 channels a lane where memory allows, otherwise one.
#pragma once

#include <cstdint>
#include <type_traits>

// Calls `run` with the channels of a lane and the lanes of a team as constants; `wide` says that every row of channels starts at
// 16 bytes.
template <class Run>
void with_team(bool wide, int64_t channels, const Run& run) {
  const auto large = std::integral_constant<int, 16>();
  if (!wide) return run(std::integral_constant<int, 1>(), large);
  const auto four = std::integral_constant<int, 4>();
  if (channels <= 32) return run(four, std::integral_constant<int, 8>());
  run(four, large);
}
