// Fused `rasterization()` on CUDA: interface between the op's host code and its kernels. All pointers are device
// memory.
//
// Forward: project (geometry, colours, tile counts), scan, fill, then sort and blend per tile. The kernels are queued for
// lists of a given capacity; the host reads the length of the lists while they run. An instance is a pair of a splat and a
// tile that it touches; instances are numbered in splat order. Backward: per tile one gradient row for every instance, per splat
// the sum of its rows, per Gaussian the gradients of its parameters. No sum depends on the execution order of blocks.
//
// An image is one batch seen by one camera. `images` = batches * cameras, and image i belongs to batch i / cameras.
#pragma once

#include <cuda_runtime.h>

#include "../frame/frame.h"
#include "../projection/projection.h"
#include "cuda_scratch.h"

namespace gsplat::rasterization {

constexpr int kPlainColors = -1;     // value of `degree` if colours are given directly
constexpr int kSplatFloats = 12;     // floats of a splat's record, and of its gradient
constexpr int kMostPlainColors = 3;  // the record's fourth channel is the depth
constexpr int kViewSums = 15;        // gradient sums per camera: rotation row by row, translation, centre

struct Scene {
  projection::ProjectionInput projection;  // inputs of the first batch and camera
  const float* colors;                     // [batches or images, N, color_row]; null: no colours are rendered
  const float* centers;                    // [images, 3]; null: computed from the view matrices
  const float* backgrounds;                // [images, channels without depth]; null: black
  int64_t gaussians;
  int32_t batches, cameras;
  int32_t degree;     // of the spherical harmonics, or kPlainColors
  int32_t color_row;  // floats per Gaussian in `colors`
  int32_t channels;   // colour channels of the image, 0 to 3
  bool depth;         // the last channel is the weighted sum of z ...
  bool expected;      // ... divided by alpha (expected depth)
  bool colors_per_camera, antialiased;
  int32_t width, height, tile_width, tile_height;

  constexpr int64_t images() const { return int64_t(batches) * cameras; }
  constexpr int64_t tiles() const { return int64_t(tile_width) * tile_height; }                // per image
  constexpr int64_t blocks() const { return blocks_for(gaussians, frame::kGaussianThreads); }  // blocks of Gaussians per image
  constexpr int32_t image_channels() const { return channels + (depth ? 1 : 0); }
};

// Projected splats [images, N]; zero where culled. `opacities` is null unless antialiased. Records of culled splats are
// not written.
struct Splats {
  float *means2d, *depths, *conics, *opacities;
  int32_t *radii, *tiles_per_gauss;
  float* records;  // [images, N, kSplatFloats]
};

// Tile lists of all images, concatenated; lengths are in instances. If the capacity is exceeded, instances are dropped
// and the picture is incomplete.
struct Lists {
  int32_t* tile_offsets;     // [images * tiles]; scan writes one more entry, the total length
  int32_t* splat_starts;     // [images * N + 1]
  uint64_t* keys;            // scratch: depth bits << 32 | instance
  int32_t* instance_splats;  // scratch: splat of every instance, within its image
  int32_t* flatten_ids;      // ordered by tile and depth: image * N + splat
  int64_t* isect_ids;        // ordered by tile and depth: image | tile | depth bits, in gsplat's format
  int32_t* sorted;           // ordered by tile and depth: the instance; null if no gradient is needed
  int64_t capacity;          // forward: number of instances in the buffers above
  int64_t length;            // backward
  int64_t tiles;             // of all images

  // Return the start of a tile's list; for tile = tiles, the end of the last list.
  __host__ __device__ int begin(int64_t tile) const { return tile < tiles ? tile_offsets[tile] : int(length); }
  // Return the same start in the forward pass, where the host does not know the length yet; at most `capacity`.
  __device__ int begin_within_capacity(int64_t tile) const {
    return tile_offsets[tile] < capacity ? tile_offsets[tile] : int(capacity);
  }
};

struct Pixels {
  float* image;   // [images, H, W, image_channels]
  float* alphas;  // [images, H, W]
  float* depths;  // [images, H, W] or null: expected depth, for the gradient
  int32_t* last;  // [images, H, W]: position of the last blended instance, or -1; null if no gradient is needed
};

void project(const Scene& scene, const Splats& out, const frame::Scratch& scratch, cudaStream_t stream);
// Compute the lists' offsets and starts; their length is written to status[frame::kStatusNeeded]. The status may be in
// page-locked host memory.
// `scratch.block_counts` has one sum per block of each image.
void scan(const Scene& scene, const Lists& lists, int32_t* status, const frame::Scratch& scratch, cudaStream_t stream);
void fill(const Scene& scene, const Splats& splats, const Lists& lists, const frame::Scratch& scratch, cudaStream_t stream);
void blend(const Scene& scene, const Splats& splats, const Lists& lists, const Pixels& out, cudaStream_t stream);

// One row per visible splat, ordered by image and Gaussian; gsplat's packed mode.
struct PackedSplats {
  int64_t *batch_ids, *camera_ids, *gaussian_ids;
  Splats rows;      // the records are unused
  int32_t* row_of;  // [images, N]: row of each splat, or -1
};
// Write the number of visible splats of each block of Gaussians to `counts` [images * blocks].
void count_visible(const Scene& scene, const Splats& splats, uint32_t* counts, cudaStream_t stream);
// Write the rows of the visible splats. `block_starts` [images * blocks + 1]: number of visible splats in all preceding
// blocks; the last entry is the total.
void pack(const Scene& scene, const Splats& splats, const int32_t* block_starts, const PackedSplats& out, cudaStream_t stream);
// Replace splat ids by packed rows: to[i] = row_of[from[i]].
void renumber(int64_t length, const int32_t* row_of, const int32_t* from, int32_t* to, cudaStream_t stream);

// Arguments of the backward pass from the image's gradient to the splats' gradients.
struct PictureGradient {
  const float* v_image;   // null: zero
  const float* v_alphas;  // null: zero
  const float* alphas;    // this and the next two from the forward pass
  const float* depths;
  const int32_t* last;
};
struct SplatSums {
  const float* conics;    // [rows, 3], from the forward pass
  const int32_t* row_of;  // [images, N]; null: row i is splat i
  float* v_splats;        // [images, N, kSplatFloats]: 6 moments, 4 channels, 2 sums of |dL/dmean|; zero where culled
  float* v_means2d;       // [rows, 2]
  float* v_absolute;      // [rows, 2] or null
};
void instance_gradients(const Scene& scene, const float* records, const Lists& lists, const PictureGradient& from, bool absolute,
                        float* rows, cudaStream_t stream);
void splat_gradients(const Scene& scene, const int32_t* splat_starts, const float* rows, const SplatSums& out,
                     cudaStream_t stream);

// Arguments of the backward pass from the splats' gradients to the inputs' gradients. A null input is zero; a null
// output is not computed.
struct ProjectedGradients {
  const int32_t* radii;      // [images, N, 2]
  const int32_t* row_of;     // [images, N]; null: row i is splat i
  const float* v_splats;     // [images, N, kSplatFloats]
  const float* v_means2d;    // [rows, 2]
  const float* v_depths;     // [rows]
  const float* v_conics;     // [rows, 3]
  const float* v_opacities;  // [rows], only if antialiased
};
struct InputGradients {
  float *means, *covars, *quats, *scales, *opacities, *colors;
  float* view_sums;  // scratch: [images, blocks of Gaussians, kViewSums]
  float* viewmats;   // [images, 4, 4], must be zeroed
  float* centers;    // [images, 3]; null if the centres were computed from the matrices
};
void input_gradients(const Scene& scene, const ProjectedGradients& from, const InputGradients& to, cudaStream_t stream);

}  // namespace gsplat::rasterization
