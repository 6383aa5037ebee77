// Shared by the passes over the planes: a node's gradient, and Adam's update (Kingma and Ba 2015, algorithm 1) of its
// channels.
#pragma once

#include "../hexplane/plane_samples.cuh"
#include "training.h"

namespace gsplat::hexplane {

// Update a node's channels. `gradient_of` is called after the moments' loads are issued, and `value_of` only if the
// update changes the value. Most nodes of a fine grid never have a Gaussian nearby, and cost only two loads.
template <int kLane, class Value, class Gradient>
__device__ __forceinline__ void update(const PlaneMoments& plane, int64_t at, const Value& value_of, const Gradient& gradient_of,
                                       const AdamStep& adam) {
  Channels<kLane> m = Channels<kLane>::load(plane.first + at), v = Channels<kLane>::load(plane.second + at);
  const Channels<kLane> gradient = gradient_of();
  bool idle = true;
#pragma unroll
  for (int i = 0; i < kLane; ++i) idle = idle && gradient.v[i] == 0.0f && m.v[i] == 0.0f && v.v[i] == 0.0f;
  if (idle) return;
  Channels<kLane> p = value_of();
  const AdamStep step = adam;  // read after the gradient, whose computation needs the registers
#pragma unroll
  for (int i = 0; i < kLane; ++i) {
    const float g = gradient.v[i];
    const bool finite = isfinite(g * g);  // a non-finite value would persist in the moments
    const float m_new = m.v[i] + step.fresh1 * (g - m.v[i]), v_new = v.v[i] + step.fresh2 * (g * g - v.v[i]);
    const float p_new = p.v[i] - step.rate * m_new / (sqrtf(v_new) * step.inv_bias2 + step.epsilon);
    m.v[i] = finite ? m_new : m.v[i];
    v.v[i] = finite ? v_new : v.v[i];
    p.v[i] = finite ? p_new : p.v[i];
  }
  p.store(plane.values + at);
  m.store(plane.first + at);
  v.store(plane.second + at);
}

// Mapping of a launch's blocks to planes of different sizes, slot by slot; slot = 3 * level + plane.
struct PlaneBlocks {
  int32_t first_block[3 * kMaxFieldLevels + 1];
  int32_t count;
};

__device__ __forceinline__ int slot_of_block(const PlaneBlocks& slots) {
  int slot = 0;
  while (int(blockIdx.x) >= slots.first_block[slot + 1]) ++slot;
  return slot;
}

// Return the sorted Gaussians of a slot's space plane.
__device__ __forceinline__ SortedCells sorted_cells(const FieldPlanes& planes, const FieldCells& cells, const FieldRows& rows,
                                                    int slot) {
  const int level = slot / 3, p = slot % 3;
  return {cells.starts + cells.first[level][p], rows.space, rows.fractions, rows.dense_sums, planes.sizes[level][minor_axis(p)]};
}

template <int kLane>
__device__ Channels<kLane> space_gradient(const FieldPlanes& planes, const FieldCells& cells, const FieldRows& rows, int slot,
                                          int u, int v, int channel) {
  const bool v_major = v_axis(slot % 3) == major_axis(slot % 3);
  return node_gradient<kLane>(sorted_cells(planes, cells, rows, slot), v_major ? v : u, v_major ? u : v, channel,
                              planes.channels);
}

}  // namespace gsplat::hexplane
