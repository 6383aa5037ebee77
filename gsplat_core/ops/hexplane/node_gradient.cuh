// The gradient of one node of a plane: its share of the rows of the Gaussians in the four cells around it, in their sorted order.
#pragma once

#include "plane_samples.cuh"

namespace hexplane {

constexpr int kCrowded = 8;    // Gaussians of a cell whose rows are added up ahead, once for its four corners
constexpr int kCrowdRun = 32;  // sorted Gaussians whose sums are taken together
constexpr int kNodeBatch = 2;  // rows of a node that are on their way at once: few, so that many nodes are

// One plane's Gaussians, sorted by cell = along the major axis * minor size + along the minor axis.
struct SortedCells {
  const int32_t* starts;  // of the plane's first cell
  const float* rows;      // [all planes' items, C], sorted: gradient of the plane's sample
  const float* shares;    // [items, 2]: of the way to the right node along the major and the minor axis
  const float* crowds;    // crowded cells' sums for their corners (training_cuda.h); null: none
  int32_t minor_size;
};

// How much of a sample comes from node `node`, when the point lies at `at`.
__device__ __forceinline__ float share_of(const LinePosition& at, int node) {
  return int(at.cell) == node ? 1.0f - at.fraction : int(at.cell) == node - 1 ? at.fraction : 0.0f;
}

// Calls use(i, share along major, along minor, row) for the sorted items [begin, end) in order; kBatch of them are loaded at a
// time.
template <int kLane, int kBatch, class Use>
__device__ __forceinline__ void for_rows(const SortedCells& cells, int32_t begin, int32_t end, int channel, int channels,
                                         const Use& use) {
  for (int32_t i = begin; i < end; i += kBatch) {
    Channels<kLane> row[kBatch];
    float2 share[kBatch];
#pragma unroll
    for (int k = 0; k < kBatch; ++k) {
      const int64_t at = min(i + k, end - 1);
      row[k] = Channels<kLane>::load(cells.rows + at * channels + channel);
      share[k] = *reinterpret_cast<const float2*>(cells.shares + 2 * at);
    }
#pragma unroll
    for (int k = 0; k < kBatch; ++k)
      if (i + k < end) use(i + k, share[k].x, share[k].y, row[k]);
  }
}

// Where the sums of a crowded cell's rows in run `run` are: [runs, 5, 4, C], the first of five for the cell that begins in an
// earlier run, the others for those that begin in one of the run's quarters, where no two do.
__device__ __forceinline__ int64_t crowd_place(int run, bool begins, int32_t begin, int corner) {
  return (int64_t(run) * 5 + (begins ? 1 + begin % kCrowdRun / kCrowded : 0)) * 4 + corner;
}

template <int kLane>
__device__ Channels<kLane> node_gradient(const SortedCells& cells, int major, int minor, int channel, int channels) {
  Channels<kLane> sum = Channels<kLane>::all(0.0f);
#pragma unroll 1
  for (int left = 0; left < 2; ++left) {  // the cell that the node is the left corner of along the major axis comes last
    const int cell_major = major - 1 + left;
    if (cell_major < 0) continue;
    const int32_t* starts = cells.starts + int64_t(cell_major) * cells.minor_size + minor;
    const int32_t bounds[3] = {starts[minor > 0 ? -1 : 0], starts[0], starts[1]};
    if (bounds[0] == bounds[2]) continue;
#pragma unroll
    for (int low = 0; low < 2; ++low) {
      const int32_t begin = bounds[low], end = bounds[low + 1];
      if (cells.crowds != nullptr && end - begin >= kCrowded) {
        const int first = begin / kCrowdRun, corner = 2 * (1 - left) + (1 - low);
        for (int run = first; run <= (end - 1) / kCrowdRun; ++run)
          sum = plus(sum, 1.0f,
                     Channels<kLane>::load(cells.crowds + crowd_place(run, run == first, begin, corner) * channels + channel));
        continue;
      }
      for_rows<kLane, kNodeBatch>(cells, begin, end, channel, channels,
                                  [&](int32_t, float along, float across, const Channels<kLane>& row) {
                                    sum = plus(sum, (left ? 1.0f - along : along) * (low ? 1.0f - across : across), row);
                                  });
    }
  }
  return sum;
}

}  // namespace hexplane
