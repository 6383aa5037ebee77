// Vectors over a pixel's disparities, with a width that divides their number. For CPU kernels.
#pragma once

#include "integer_vectors.h"
#include "stereo_matching.h"

namespace GSPLAT_ISA::stereo_matching {

using namespace gsplat::stereo_matching;

GSPLAT_INLINE int64_t within(int64_t i, int64_t size) { return less(more(i, int64_t(0)), size - 1); }

// Call work with the widest of 64, 32 and 16 lanes, as a constant, that divides `count` and does not exceed kMost.
template <int kWide>
struct Width {
  static constexpr int value = kWide;
};
template <int kMost, class Work>
GSPLAT_INLINE void with_width(int count, const Work& work) {
  if (kMost >= 64 && count % 64 == 0)
    work(Width<64>());
  else if (kMost >= 32 && count % 32 == 0)
    work(Width<32>());
  else
    work(Width<16>());
}

// Kernels defined in costs_cpu.cpp and winners_cpu.cpp, with the scratch memory that they need.
int64_t cost_scratch(const Pair& pair);
void sum_costs(const Pair& pair, uint8_t* costs, int64_t begin, int64_t end, uint8_t* scratch);
void winners(const Pair& pair, const uint8_t* costs, const uint8_t* messages, int32_t* sixteenths, int64_t begin, int64_t end,
             uint32_t* scratch);
void drop_patches(const Pair& pair, int32_t* sixteenths, int32_t* scratch);
void surfaces(const Pair& pair, const Matched& matched, int64_t begin, int64_t end, int32_t* scratch);

}  // namespace GSPLAT_ISA::stereo_matching
