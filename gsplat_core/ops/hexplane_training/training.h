// Training of the HexPlane field on CUDA without autograd: forward, gradients, and Adam over planes and network. All pointers are
// device memory.
//
// No sum is made by atomic additions of floats. The backward pass writes one gradient row per Gaussian, level and plane.
// Gaussians are sorted by their cell of each space plane, so that a node's gradient is the sum of the rows of its four cells in
// that order. The optimiser computes it in the pass that updates the node; the planes' gradient is never stored. The gradient of
// a time plane is confined to the two rows around the time, which share the gradient of the line interpolated between them.
#pragma once

#include "../adam/adam.h"
#include "../hexplane/hexplane.h"
#include "../hexplane_deltas/network.h"

namespace gsplat::hexplane {

using adam::AdamStep;

// The cells of space plane p are ordered along its major axis, so that those around a node of that axis are contiguous.
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

// The Gaussians sorted by cell. slot = 3 * level + plane, item = slot * N + Gaussian; items are sorted by their cell of the
// slot's plane and within a cell by Gaussian. Items of Gaussians that are left out come last.
struct FieldCells {
  float* coordinates;  // [N, 4] in [-1, 1]; the fourth is 0 for a Gaussian that is left out because its position is not finite
  int32_t* starts;     // [cells + 1] of the cell's items
  int32_t* items;      // [slots * N], sorted
  int32_t* ranks;      // [slots * N]: the index of an item among the sorted ones
  uint32_t* keys;      // [slots * N]: cells of the sorted items, with kDenseBit in dense ones
  int64_t first[kMaxFieldLevels][3];  // a slot's first cell
  int64_t cells, count;
};

// A dense cell has so many items that their gradient rows are summed in a pass of their own.
constexpr uint32_t kDenseBit = uint32_t(1) << 31;
__host__ __device__ constexpr bool is_dense(uint32_t key) { return (key & kDenseBit) != 0; }
__host__ __device__ constexpr uint32_t cell_of(uint32_t key) { return key & ~kDenseBit; }

constexpr int plane_of_major(int axis) { return axis == 0 ? 1 : axis == 1 ? 0 : 2; }  // x: xz, y: xy, z: yz

struct FieldRows {
  float* space;      // [slots * N, C], sorted: gradient of the sample of the plane
  float* lines;      // the same for the line of the plane's major axis
  float* fractions;  // [slots * N, 2], sorted: of the way to the next node along the major and the minor axis
  // [slots * N / 32, 5, 4, C]: for each run of 32 sorted items, sums of the rows of the dense cells in it for the cells' four
  // corners. dense_place() says which of the five places a cell has; other places are not written.
  float* dense_sums;
};

// Coordinates of `means` [N, 3] in `box` [2, 3].
void place_gaussians(const float* means, const float* box, const FieldCells& cells, cudaStream_t stream);

// From the coordinates to everything else in `cells`.
void sort_gaussians(const FieldPlanes& planes, const FieldCells& cells, CudaScratch& scratch, cudaStream_t stream);

// features [N, levels * C]: products of the samples of space planes and lines; 0 for Gaussians that are left out.
void field_features(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, float* features,
                    cudaStream_t stream);

// From v_raw [N, 16] to the gradient of the features [N, levels * C] and, layer by layer, of the layers' sums: v_hidden, of the
// padded width as `hidden` [layers - 1, N, width], and v_head [N, 16]. A row of v_raw that is not finite counts as zero.
void network_backward(const FieldNetwork& net, const float* v_raw, const float* hidden, float* v_features, float* v_hidden,
                      float* v_head, int64_t count, CudaScratch& scratch, cudaStream_t stream);

// The gradient of weights and biases, layer by layer: weight [outputs, inputs], then bias.
void network_weight_gradient(const FieldNetwork& net, const float* features, const float* hidden, const float* v_hidden,
                             const float* v_head, float* gradient, int64_t count, CudaScratch& scratch, cudaStream_t stream);

// Rows for all planes and lines, and the gradient of the positions, which is added to the first three columns of v_raw.
void field_rows(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const float* box,
                const float* v_features, const FieldRows& rows, float* v_raw, cudaStream_t stream);

// Fills rows.dense_sums, so that the rows of a dense cell are read once and not by each of the nodes around it.
void sum_dense_cells(const FieldPlanes& planes, const FieldCells& cells, const FieldRows& rows, cudaStream_t stream);

// The gradient of the lines, in their layout.
void line_gradient(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const FieldRows& rows,
                   float* gradient, CudaScratch& scratch, cudaStream_t stream);

struct PlaneMoments {
  float *values, *first, *second;  // [V, U, C]
};

struct PlanesState {
  PlaneMoments space[kMaxFieldLevels][3], time[kMaxFieldLevels][3];
  int32_t time_rows[kMaxFieldLevels][3];  // V
};

// Weights of the penalties of deformation/regularisers.py, each of which is a mean over planes.
struct PlanePenalties {
  float smoothness;       // total variation of the space planes
  float time_smoothness;  // second difference in time of the time planes
  float sparsity;         // distance of the time planes from 1
};

// Computed by one thread before the pass, so that not every thread computes powers of the decay rates.
struct AdamScalars {
  AdamStep step;
  bool skip;  // the frame overflowed: change nothing
};

struct PlanesAdam {
  const float* rate;      // one number
  const int64_t* step;    // counts from 1
  const int32_t* status;  // of a frame, or null; if it overflowed, nothing is changed
  double beta1, beta2, epsilon;
  PlanePenalties penalties;
};

void planes_adam(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const FieldRows& rows,
                 const float* line_gradient, const float* time, const PlanesState& state, const PlanesAdam& options,
                 CudaScratch& scratch, cudaStream_t stream);

// The pass with penalties (planes_penalties.cu), over the space planes and over the time planes. `wide`: all rows are aligned to
// 16 bytes.
void smooth_space_planes(bool wide, const FieldPlanes& planes, const FieldCells& cells, const FieldRows& rows,
                         const PlanesState& state, float smoothness, const AdamScalars* scalars, CudaScratch& scratch,
                         cudaStream_t stream);
void smooth_time_planes(const FieldPlanes& planes, const FieldLines& lines, const float* line_gradient, const float* time,
                        const PlanesState& state, const PlanePenalties& penalties, const AdamScalars* scalars,
                        cudaStream_t stream);

// The gradients themselves, of the sizes of the planes.
struct PlaneGradients {
  float *space[kMaxFieldLevels][3], *time[kMaxFieldLevels][3];
  int32_t time_rows[kMaxFieldLevels][3];
};

void planes_gradient(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const FieldRows& rows,
                     const float* line_gradient, const float* time, const PlaneGradients& gradients, cudaStream_t stream);

// The network's weights and biases, whose gradient and moments are concatenated in this order.
struct NetworkParameters {
  float* values[2 * kMaxFieldLayers];
  int32_t starts[2 * kMaxFieldLayers + 1];
  int32_t count;
};

void network_adam(const NetworkParameters& parameters, const float* gradient, float* first, float* second,
                  const PlanesAdam& options, cudaStream_t stream);

}  // namespace gsplat::hexplane
