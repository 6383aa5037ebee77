// The gradient of one node of a plane: its share of the rows of the Gaussians in the four cells around it, in their sorted order.
#pragma once

#include "plane_samples.cuh"

namespace hexplane {

// One plane's Gaussians, sorted by cell = along the major axis * minor size + along the minor axis.
struct SortedCells {
  const int32_t* starts;     // of the plane's first cell
  const int32_t* items;      // of all planes; item - first_item is a Gaussian
  const float* coordinates;  // [N, 4]
  const float* rows;         // [N, C]: gradient of the plane's sample
  int64_t first_item;
  int32_t major, minor;  // axes of the coordinates
  int32_t major_size, minor_size;
};

// How much of a sample comes from node `node`, when the point lies at `at`.
__device__ __forceinline__ float share_of(const LinePosition& at, int node) {
  return int(at.cell) == node ? 1.0f - at.fraction : int(at.cell) == node - 1 ? at.fraction : 0.0f;
}

template <int kLane>
__device__ Channels<kLane> node_gradient(const SortedCells& cells, int major, int minor, int channel, int channels) {
  Channels<kLane> sum = Channels<kLane>::all(0.0f);
  for (int cell = major > 0 ? major - 1 : 0; cell <= major; ++cell) {
    const int32_t* starts = cells.starts + int64_t(cell) * cells.minor_size;
    const int32_t end = starts[minor + 1];
#pragma unroll 4
    for (int32_t i = starts[minor > 0 ? minor - 1 : 0]; i < end; ++i) {
      const int64_t n = cells.items[i] - cells.first_item;
      const float share = share_of(position_on(cells.coordinates[4 * n + cells.major], cells.major_size), major) *
                          share_of(position_on(cells.coordinates[4 * n + cells.minor], cells.minor_size), minor);
      sum = plus(sum, share, Channels<kLane>::load(cells.rows + n * channels + channel));
    }
  }
  return sum;
}

}  // namespace hexplane
