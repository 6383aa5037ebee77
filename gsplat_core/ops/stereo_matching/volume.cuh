// Distribution of a pixel's disparities over a warp: each lane holds kEach consecutive ones. Lanes beyond their number
// hold none.
#pragma once

#include "stereo_matching.h"

namespace gsplat::stereo_matching {

constexpr unsigned kAllLanes = ~0u;

// Load and store of kEach bytes in one instruction.
template <int kEach>
struct Packed;
template <>
struct Packed<1> {
  using type = uint8_t;
};
template <>
struct Packed<2> {
  using type = uint16_t;
};
template <>
struct Packed<4> {
  using type = uint32_t;
};
template <>
struct Packed<8> {
  using type = uint64_t;
};

template <int kEach>
__device__ inline int byte_of(typename Packed<kEach>::type packed, int k) {
  return int(packed >> (8 * k)) & 255;
}

// Call work with the smallest sufficient number of disparities per lane, a power of two, as a constant.
template <class Work>
void with_each(int count, const Work& work) {
  if (count <= 32)
    work(std::integral_constant<int, 1>());
  else if (count <= 64)
    work(std::integral_constant<int, 2>());
  else if (count <= 128)
    work(std::integral_constant<int, 4>());
  else
    work(std::integral_constant<int, 8>());
}

// Steps of the matching, defined in costs.cu, paths.cu and winners.cu; each queues its kernels on the stream. A volume
// is [height, width, count]. sums: scratch of two bytes per cost.
void sum_costs(const Pair& pair, uint8_t* costs, uint16_t* sums, CudaScratch& scratch, cudaStream_t stream);
void follow_paths(const Pair& pair, const uint8_t* costs, uint8_t* messages, cudaStream_t stream);  // messages: kPaths volumes
void choose(const Pair& pair, const uint8_t* costs, const uint8_t* messages, int32_t* sixteenths, CudaScratch& scratch,
            cudaStream_t stream);
void drop_patches(const Pair& pair, int32_t* sixteenths, CudaScratch& scratch, cudaStream_t stream);

}  // namespace gsplat::stereo_matching
