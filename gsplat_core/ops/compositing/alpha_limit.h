// Check of the upper bound of alpha that callers pass.
#pragma once

#include <cmath>

#include "constants.h"
#include "tensor_checks.h"

namespace gsplat::compositing {
namespace {

AlphaLimit limit_of(double max_alpha) {
  check(max_alpha >= kAlphaCutoff && max_alpha < 1, "max_alpha must be from 1/255 to below 1, found ", max_alpha);
  const float most = float(max_alpha);
  // For kMaxAlpha use the compiled constant, because its last bit differs from that of the logarithm rounded here.
  return most == kMaxAlpha ? AlphaLimit{} : AlphaLimit{most, float(std::log2(max_alpha))};
}

}  // namespace
}  // namespace gsplat::compositing
