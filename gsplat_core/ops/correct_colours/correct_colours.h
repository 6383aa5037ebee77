// Repeated correction of the splats' colours by the residual of a picture, with fixed geometry (CPU).
//
// The blending weights of a picture do not depend on the colours. They are computed once, and each iteration only
// multiplies them with the colours and the residual.
#pragma once

#include <cstdint>

#include "../compositing/compositing.h"
#include "isa.h"

namespace gsplat::correct_colours {

using compositing::kWindow;
using compositing::Splats;

constexpr int kSums = 4;       // of a splat in a tile: weight times residual in three channels, and weight in the mask
constexpr int kBlockBits = 6;  // of a code
constexpr int kMostLanes = 16;
constexpr int kTargetFloats = kSums * kWindow * kWindow;

// Picture whose difference from the displayed one is the residual.
struct Picture {
  const uint8_t* image;  // [height, width, 3]
  const uint8_t* mask;   // [height, width], 0 for pixels without a residual
};

// Blending weights and target of one tile. A pair is a splat and a block of pixels in which its weight is not 0.
struct TileWeights {
  float* values;   // [pairs, lanes]: weights, in the order of the blending
  int32_t* codes;  // [pairs]: position in the tile's list times 2^kBlockBits, plus the block
  int32_t* order;  // [pairs]: pairs sorted by splat
  int32_t* first;  // [splats of the tile + 1]: first pair of each splat in `order`
  float* target;   // [kSums, pixels]: picture in the mask in three channels, and the mask, block by block
  int64_t pairs;
};

struct Kernels {
  // Number of floats in a SIMD vector.
  int64_t lanes;
  // Prepares the splats [begin, end) for blending, in `records`.
  void (*records)(const compositing::Inputs& in, int64_t begin, int64_t end, compositing::SplatRecord* records);
  // Returns an upper bound of the number of pairs of a tile.
  int64_t (*most_pairs)(const Splats& in, int64_t tile);
  // Computes the weights and the target of a tile in `out`, and returns the number of pairs.
  int64_t (*weigh)(const Splats& in, int64_t tile, const Picture& picture, const TileWeights& out);
  // Writes the sums of the tile's splats to their rows [instances, kSums], the weight only if `weighs`. `shown` [count,
  // kSums] are the displayed colours.
  void (*sums)(const Splats& in, int64_t tile, const TileWeights& weights, const float* shown, bool weighs, const int32_t* row_of,
               float* rows);
};

}  // namespace gsplat::correct_colours

GSPLAT_KERNELS(correct_colours, Kernels)
