// Semi-global matching (Hirschmüller 2008) of two rectified grey images. Integer arithmetic with fixed tie-breaking:
// CPU, CUDA and the oracle give identical results.
//
// The matching cost of a disparity at a pixel is the Birchfield-Tomasi (1998) difference of horizontal slopes and of
// brightness, summed over a window. A path along the row or column adds a "message" for each disparity: the minimum
// cost of reaching it from the previous pixel. The total is four times the cost plus the messages of four paths.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::stereo_matching {

constexpr int kCountStep = 16, kMostDisparities = 256;
constexpr int64_t kMostSide = 16384, kMostPixels = int64_t(1) << 23;
constexpr int kSlopeCap = 63;                         // slopes are clamped to +-this
constexpr int kBrightnessMost = 255 - 2 * kSlopeCap;  // brightness differences are clamped to this
constexpr int kWindowRadius = 4, kWindowSide = 2 * kWindowRadius + 1;
constexpr int kCostShift = 6;                    // a cost is the window's sum shifted right by this
constexpr int kSmallStep = 12, kLargeStep = 49;  // penalties of a disparity change by one, and by more
constexpr int kMostCost = 255 - kLargeStep;      // cost plus message fits a byte, and so do four messages
constexpr int kUniquenessPercent = 5;            // required margin of the best disparity over all but its neighbours
constexpr int kLeftRightMost = 1;                // maximum difference of the left-right consistency check
constexpr int kSixteenths = 16;                  // results are in units of 1/16 pixel
// Patches of at most so many pixels that differ from their surroundings by more than the step are removed.
constexpr int kPatchPixels = 100, kPatchStep = 2 * 16;
// one_surface requires that disparity changes by at most kJumpMost within kJumpRadius, and that no hole is within kHoleRadius.
constexpr int kJumpRadius = 5, kJumpMost = 2 * 16, kHoleRadius = 2;
constexpr int kMostLowest = 1 << 14;
constexpr int32_t kUnknown = INT32_MIN;

// Number of paths at a pixel: both directions along its row and its column.
constexpr int kPaths = 4;

struct Pair {
  const uint8_t *left, *right;  // [height, width]
  int32_t height, width, lowest, count;
};

// [height, width] each.
struct Matched {
  int32_t* sixteenths;   // per pixel; kUnknown where no disparity was found
  uint8_t* one_surface;  // 1 if no disparity jump and no hole is nearby
};

// CPU kernels. Volumes are stored pixel by pixel, with a pixel's disparities contiguous.
struct Kernels {
  int64_t (*row_scratch)(const Pair& pair);  // bytes of scratch per thread for `rows`
  int64_t (*column_scratch)(const Pair& pair, int64_t columns);
  // Computes costs and the messages along the rows, for rows [begin, end). Results do not depend on the partition into
  // rows.
  void (*rows)(const Pair& pair, uint8_t* costs, uint8_t* messages, int64_t begin, int64_t end, uint8_t* scratch);
  // Adds the messages down and up the columns [begin, end).
  void (*columns)(const Pair& pair, const uint8_t* costs, uint8_t* messages, int64_t begin, int64_t end, uint8_t* scratch);
  // Finds the best disparities of rows [begin, end), with the left-right consistency check. scratch: width numbers.
  void (*winners)(const Pair& pair, const uint8_t* costs, const uint8_t* messages, int32_t* sixteenths, int64_t begin,
                  int64_t end, uint32_t* scratch);
  // Removes small patches from the whole plane. scratch: 2 * height * width numbers.
  void (*drop_patches)(const Pair& pair, int32_t* sixteenths, int32_t* scratch);
  // Fills `one_surface`. scratch: 3 * (width + 2 * kJumpRadius) numbers.
  void (*surfaces)(const Pair& pair, const Matched& matched, int64_t begin, int64_t end, int32_t* scratch);
};

// Stereo matching on CUDA; all pointers are device memory.
void match_on_device(const Pair& pair, const Matched& matched, CudaScratch& scratch, cudaStream_t stream);

}  // namespace gsplat::stereo_matching

GSPLAT_KERNELS(stereo_matching, Kernels)
