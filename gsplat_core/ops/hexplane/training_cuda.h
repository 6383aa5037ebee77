// Training of the HexPlane field on CUDA without autograd: forward, and gradients of everything. All pointers are to device
// memory.
//
// No sum is made by atomic additions of floats. The backward pass writes one row of gradient per Gaussian, level and plane;
// Gaussians are sorted by their cell of each space plane, so that whoever needs a node's gradient adds the rows of its four cells
// in that order: the optimiser does, in the pass in which it updates the node, and no gradient of the planes is ever in memory.
// The gradient of a time plane lies in the two rows around the time, which share the gradient of the line between them.
#pragma once

#include "hexplane.h"
#include "network_cuda.h"

// Space plane p of a level has cells in the order of its major axis, so that those around a node of the major axis lie together.
constexpr int major_axis(int p) { return p == 0 ? 1 : p == 1 ? 0 : 2; }  // xy: y, xz: x, yz: z
constexpr int minor_axis(int p) { return p == 0 ? 0 : p == 1 ? 2 : 1; }

struct FieldPlanes {
  const float* space[kFieldLevels][3];  // xy, xz, yz: [V, U, C]
  int32_t sizes[kFieldLevels][3];       // cells along x, y, z
  int32_t levels, channels;

  __host__ __device__ FeaturePlane plane(int level, int p) const {
    return {space[level][p], sizes[level][p < 2 ? 0 : 1], sizes[level][p < 1 ? 1 : 2]};
  }
};

// Where the Gaussians are: slot = 3 * level + plane, item = slot * N + Gaussian, sorted by the cell of its slot's plane and,
// within one, by Gaussian; those that take no part come last.
struct FieldCells {
  float* coordinates;  // [N, 4] in [-1, 1]; the fourth is 0 for a Gaussian that takes no part because its position is not finite
  int32_t* starts;     // [cells + 1] of the cell's items
  int32_t* items;      // [slots * N], sorted
  int32_t* ranks;      // [slots * N]: place of an item among the sorted ones
  uint32_t* keys;      // [slots * N]: cells of the sorted items, and whether they are crowded
  int64_t first[kFieldLevels][3];  // a slot's first cell
  int64_t cells, count;
};

// A cell in the keys of its items says whether it is crowded: whether it has so many that their rows are added up ahead.
constexpr uint32_t kCrowdedBit = uint32_t(1) << 31;
__host__ __device__ constexpr bool is_crowded(uint32_t key) { return (key & kCrowdedBit) != 0; }
__host__ __device__ constexpr uint32_t cell_of(uint32_t key) { return key & ~kCrowdedBit; }

constexpr int plane_of_major(int axis) { return axis == 0 ? 1 : axis == 1 ? 0 : 2; }  // x: xz, y: xy, z: yz

struct FieldRows {
  float* space;   // [slots * N, C], sorted: gradient of the plane's sample
  float* lines;   // the same for the line of the plane's major axis
  float* shares;  // [slots * N, 2], sorted: fractions of the way to the next node along the major and the minor axis
  // [slots * N / 32, 5, 4, C]: of the crowded cells in 32 sorted items, the sums of their rows there for their four corners, the
  // second along the minor axis first; which one has which of five places says crowd_place, and other places are not written
  float* crowds;
};

// Coordinates of `means` [N, 3] in `box` [2, 3].
void place_gaussians(const float* means, const float* box, const FieldCells& cells, cudaStream_t stream);

// From the coordinates to everything else in `cells`.
void sort_gaussians(const FieldPlanes& planes, const FieldCells& cells, CudaScratch& scratch, cudaStream_t stream);

// features [N, levels * C]: products of the samples of space planes and lines; 0 for Gaussians that take no part.
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

// Fills rows.crowds: the rows of a crowded cell are read once, and do not hold up the nodes around it.
void sum_crowds(const FieldPlanes& planes, const FieldCells& cells, const FieldRows& rows, cudaStream_t stream);

// The gradient of the lines, laid out as they are.
void line_gradient(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const FieldRows& rows,
                   float* gradient, CudaScratch& scratch, cudaStream_t stream);
