// A launch with a team of lanes per point: 4 channels a lane where memory allows, otherwise one.
#pragma once

#include <cstdint>
#include <type_traits>

// Calls `run` with the channels of a lane and the lanes of a team as constants. Every row of channels must start at 16 bytes.
template <class Run>
void with_wide_team(int64_t channels, const Run& run) {
  const auto four = std::integral_constant<int, 4>();
  if (channels <= 32) return run(four, std::integral_constant<int, 8>());
  run(four, std::integral_constant<int, 16>());
}

// The same where rows of channels may start anywhere: 4 channels a lane only if `wide`.
template <class Run>
void with_team(bool wide, int64_t channels, const Run& run) {
  if (wide) return with_wide_team(channels, run);
  run(std::integral_constant<int, 1>(), std::integral_constant<int, 16>());
}
