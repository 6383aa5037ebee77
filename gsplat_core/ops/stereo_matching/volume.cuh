// How a warp holds the disparities of a pixel: each lane kEach of them, one after the other; lanes beyond their number have none.
#pragma once

#include "stereo_matching.h"

namespace gsplat::stereo_matching {

constexpr unsigned kAllLanes = ~0u;

// kEach bytes as one load or store.
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

// Work with the least power of two, as a constant, that is enough for each lane of a warp.
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

// In costs.cu, paths.cu, winners.cu: each queues its work on the stream. A volume is [height, width, count].
// sums: scratch of two bytes for each cost.
void sum_costs(const Pair& pair, uint8_t* costs, uint16_t* sums, CudaScratch& scratch, cudaStream_t stream);
void follow_paths(const Pair& pair, const uint8_t* costs, uint8_t* messages, cudaStream_t stream);  // kPaths volumes
void choose(const Pair& pair, const uint8_t* costs, const uint8_t* messages, int32_t* sixteenths, CudaScratch& scratch,
            cudaStream_t stream);
void drop_patches(const Pair& pair, int32_t* sixteenths, CudaScratch& scratch, cudaStream_t stream);

}  // namespace gsplat::stereo_matching
