// Semi-global matching (Hirschmüller 2008) of two grey pictures whose rows correspond. All of it is integer arithmetic with fixed
// tie-breaking: CPU, CUDA and the oracle give the same results.
//
// The cost of a disparity at a pixel is Birchfield and Tomasi's difference (1998) of the slopes along the row and of the
// brightness, summed over a window. A path along the row or column adds, for each disparity, what it costs at least to have come
// there from another one: the "message". The total is the sum of four times the cost and of the messages of four paths.
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"

class CudaScratch;

namespace gsplat::stereo_matching {

constexpr int kCountStep = 16, kMostDisparities = 256;
constexpr int64_t kMostSide = 16384, kMostPixels = int64_t(1) << 23;
constexpr int kSlopeCap = 63;                         // slopes are cut off here, to both sides
constexpr int kBrightnessMost = 255 - 2 * kSlopeCap;  // difference of brightness from which more counts the same
constexpr int kWindowRadius = 4, kWindowSide = 2 * kWindowRadius + 1;
constexpr int kCostShift = 6;                    // a cost is the window's sum without these bits
constexpr int kSmallStep = 12, kLargeStep = 49;  // costs of a change of disparity by one, and by more
constexpr int kMostCost = 255 - kLargeStep;      // cost and message together fit a byte, and so do four messages
constexpr int kUniquenessPercent = 5;            // by which the best disparity must beat those that are not beside it
constexpr int kLeftRightMost = 1;                // by which the match from the right eye may differ
constexpr int kSixteenths = 16;                  // results are in sixteenths of a pixel
constexpr int kPatchPixels = 100,
              kPatchStep = 2 * 16;  // patches of so few pixels, further than this from what is around, are dropped
constexpr int kJumpRadius = 5, kJumpMost = 2 * 16, kHoleRadius = 2;  // one surface: so little change, and no hole so near
constexpr int kMostLowest = 1 << 14;
constexpr int32_t kUnknown = INT32_MIN;

// Where the paths come from.
constexpr int kPaths = 4;

struct Pair {
  const uint8_t *left, *right;  // [height, width]
  int32_t height, width, lowest, count;
};

// [height, width] each.
struct Matched {
  int32_t* sixteenths;   // of a pixel; kUnknown where nothing was found
  uint8_t* one_surface;  // 1 where neither a jump of disparity nor a hole is near
};

// CPU. A row's disparities lie one after the other, pixel by pixel.
struct Kernels {
  int64_t (*row_scratch)(const Pair& pair);  // bytes for one thread of `rows`
  int64_t (*column_scratch)(const Pair& pair, int64_t columns);
  // Costs, and the messages along the rows, of rows [begin, end); no result depends on how rows are cut.
  void (*rows)(const Pair& pair, uint8_t* costs, uint8_t* messages, int64_t begin, int64_t end, uint8_t* scratch);
  // Adds the messages down and up the columns [begin, end).
  void (*columns)(const Pair& pair, const uint8_t* costs, uint8_t* messages, int64_t begin, int64_t end, uint8_t* scratch);
  // The best disparities of rows [begin, end), checked from the right eye. scratch: width numbers.
  void (*winners)(const Pair& pair, const uint8_t* costs, const uint8_t* messages, int32_t* sixteenths, int64_t begin,
                  int64_t end, uint32_t* scratch);
  // Drops small patches of the whole plane. scratch: 2 * height * width numbers.
  void (*drop_patches)(const Pair& pair, int32_t* sixteenths, int32_t* scratch);
  // scratch: 3 * (width + 2 * kJumpRadius) numbers.
  void (*surfaces)(const Pair& pair, const Matched& matched, int64_t begin, int64_t end, int32_t* scratch);
};

// CUDA; every pointer is to device memory.
void match_on_device(const Pair& pair, const Matched& matched, CudaScratch& scratch, cudaStream_t stream);

}  // namespace gsplat::stereo_matching

GSPLAT_KERNELS(stereo_matching, Kernels)
