// Training of the HexPlane field on CUDA without autograd: forward, gradients, and Adam over planes and network. All
// pointers are device memory.
//
// There are no atomic float additions. The backward pass writes one gradient row per Gaussian, level and plane.
// Gaussians are sorted by their cell in each space plane, and a node's gradient is the sum of the rows of its four
// cells in that order. The optimiser computes this sum in the pass that updates the node, so the planes' gradient is
// never stored. The gradient of a time plane is confined to the two rows around the current time, which share the
// gradient of the line interpolated between them.
#pragma once

#include "../adam/adam.h"
#include "../hexplane/hexplane.h"
#include "../hexplane_deltas/network.h"

namespace gsplat::hexplane {

using adam::AdamStep;

// Major axis of space plane p. Its cells are ordered such that those around a node of that axis are contiguous.
constexpr int major_axis(int p) { return p == 0 ? 1 : p == 1 ? 0 : 2; }  // xy: y, xz: x, yz: z
constexpr int minor_axis(int p) { return p == 0 ? 0 : p == 1 ? 2 : 1; }

struct FieldPlanes {
  const float* space[kMaxFieldLevels][3];  // xy, xz, yz: [V, U, C]
  int32_t sizes[kMaxFieldLevels][3];       // cells along x, y, z
  int32_t levels, channels;

  __host__ __device__ FeaturePlane plane(int level, int p) const {
    return {space[level][p], sizes[level][p < 2 ? 0 : 1], sizes[level][p < 1 ? 1 : 2]};
  }
};

// The Gaussians sorted by cell. slot = 3 * level + plane, item = slot * N + Gaussian. Items are sorted by their cell in
// the slot's plane, and within a cell by Gaussian. Items of excluded Gaussians come last.
struct FieldCells {
  // [N, 4] in [-1, 1]; the fourth value is 0 for a Gaussian that is excluded because its position is not finite
  float* coordinates;
  int32_t* starts;                    // [cells + 1]: start of each cell's items
  int32_t* items;                     // [slots * N], sorted
  int32_t* ranks;                     // [slots * N]: index of an item in sorted order
  uint32_t* keys;                     // [slots * N]: cell of each sorted item, with kDenseBit for dense cells
  int64_t first[kMaxFieldLevels][3];  // first cell of each slot
  int64_t cells, count;
};

// Marks a dense cell: a separate pass sums its items' gradient rows.
constexpr uint32_t kDenseBit = uint32_t(1) << 31;
__host__ __device__ constexpr bool is_dense(uint32_t key) { return (key & kDenseBit) != 0; }
__host__ __device__ constexpr uint32_t cell_of(uint32_t key) { return key & ~kDenseBit; }

constexpr int plane_of_major(int axis) { return axis == 0 ? 1 : axis == 1 ? 0 : 2; }  // x: xz, y: xy, z: yz

struct FieldRows {
  float* space;      // [slots * N, C], sorted: gradient of the plane's sample
  float* lines;      // as above for the line of the plane's major axis
  float* fractions;  // [slots * N, 2], sorted: fractional position between nodes along the major and the minor axis
  // [slots * N / 32, 5, 4, C]: for each run of 32 sorted items, sums of the rows of each dense cell in it for the
  // cell's four corners. dense_place() returns a cell's slot of the five; unused slots are not written.
  float* dense_sums;
};

// Compute the normalised coordinates of `means` [N, 3] in `box` [2, 3].
void place_gaussians(const float* means, const float* box, const FieldCells& cells, cudaStream_t stream);

// Compute all other members of `cells` from the coordinates.
void sort_gaussians(const FieldPlanes& planes, const FieldCells& cells, CudaScratch& scratch, cudaStream_t stream);

// Compute features [N, levels * C]: products of the samples of space planes and lines; 0 for excluded Gaussians.
void field_features(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, float* features,
                    cudaStream_t stream);

// Backpropagate v_raw [N, 16] to the features [N, levels * C] and to the pre-activations of each layer: v_hidden with
// the padded width, like `hidden` [layers - 1, N, width], and v_head [N, 16]. A non-finite row of v_raw counts as zero.
void network_backward(const FieldNetwork& net, const float* v_raw, const float* hidden, float* v_features, float* v_hidden,
                      float* v_head, int64_t count, CudaScratch& scratch, cudaStream_t stream);

// Compute the gradient of weights and biases, layer by layer: weight [outputs, inputs], then bias.
void network_weight_gradient(const FieldNetwork& net, const float* features, const float* hidden, const float* v_hidden,
                             const float* v_head, float* gradient, int64_t count, CudaScratch& scratch, cudaStream_t stream);

// Compute the rows for all planes and lines, and add the gradient of the positions to the first three columns of v_raw.
void field_rows(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const float* box,
                const float* v_features, const FieldRows& rows, float* v_raw, cudaStream_t stream);

// Fill rows.dense_sums, so that a dense cell's rows are read once instead of once per surrounding node.
void sum_dense_cells(const FieldPlanes& planes, const FieldCells& cells, const FieldRows& rows, cudaStream_t stream);

// Compute the gradient of the lines, in the lines' layout.
void line_gradient(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const FieldRows& rows,
                   float* gradient, CudaScratch& scratch, cudaStream_t stream);

struct PlaneMoments {
  float *values, *first, *second;  // [V, U, C]
};

struct PlanesState {
  PlaneMoments space[kMaxFieldLevels][3], time[kMaxFieldLevels][3];
  int32_t time_rows[kMaxFieldLevels][3];  // V
};

// Weights of the penalties of deformation/regularisers.py. Each penalty is a mean over planes.
struct PlanePenalties {
  float smoothness;       // total variation of the space planes
  float time_smoothness;  // second temporal difference of the time planes
  float sparsity;         // distance of the time planes from 1
};

// Factors of an Adam step, computed by one thread before the pass to avoid computing powers of the decay rates in every
// thread.
struct AdamScalars {
  AdamStep step;
  bool skip;  // the frame overflowed: skip the update
};

struct PlanesAdam {
  const float* rate;      // [1]
  const int64_t* step;    // [1], counts from 1
  const int32_t* status;  // status of a frame, or null; if the frame overflowed, the update is skipped
  double beta1, beta2, epsilon;
  PlanePenalties penalties;
};

void planes_adam(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const FieldRows& rows,
                 const float* line_gradient, const float* time, const PlanesState& state, const PlanesAdam& options,
                 CudaScratch& scratch, cudaStream_t stream);

// Adam update with penalties (planes_penalties.cu), one function for the space planes and one for the time planes.
// `wide`: all rows are aligned to 16 bytes.
void smooth_space_planes(bool wide, const FieldPlanes& planes, const FieldCells& cells, const FieldRows& rows,
                         const PlanesState& state, float smoothness, const AdamScalars* scalars, CudaScratch& scratch,
                         cudaStream_t stream);
void smooth_time_planes(const FieldPlanes& planes, const FieldLines& lines, const float* line_gradient, const float* time,
                        const PlanesState& state, const PlanePenalties& penalties, const AdamScalars* scalars,
                        cudaStream_t stream);

// The gradients, with the shapes of the planes.
struct PlaneGradients {
  float *space[kMaxFieldLevels][3], *time[kMaxFieldLevels][3];
  int32_t time_rows[kMaxFieldLevels][3];
};

void planes_gradient(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const FieldRows& rows,
                     const float* line_gradient, const float* time, const PlaneGradients& gradients, cudaStream_t stream);

// The network's weights and biases. Their gradients and moments are concatenated in this order.
struct NetworkParameters {
  float* values[2 * kMaxFieldLayers];
  int32_t starts[2 * kMaxFieldLayers + 1];
  int32_t count;
};

void network_adam(const NetworkParameters& parameters, const float* gradient, float* first, float* second,
                  const PlanesAdam& options, cudaStream_t stream);

}  // namespace gsplat::hexplane
