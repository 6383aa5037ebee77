// The whole of `rasterization()` on CUDA: what the op's host code asks of the kernels. All pointers are to device memory.
//
// Forward: project (geometry, colours, count of tiles), scan, then, once the host has read how long the lists are, fill, and per
// tile sort and blend. An instance is a pair of a splat and a tile that it touches; instances are numbered in the order of the
// splats. Backward: per tile one gradient row for every instance, per splat the sum of its rows, per Gaussian the way back to its
// parameters. No sum depends on the order in which blocks run.
//
// An image is one batch seen by one camera; `images` = batches * cameras, and image i is of batch i / cameras.
#pragma once

#include <cuda_runtime.h>

#include "../frame/frame.h"
#include "../projection/projection.h"
#include "cuda_scratch.h"

namespace gsplat::rasterization {

constexpr int kPlainColors = -1;     // in place of a degree: colours are taken as they are
constexpr int kSplatFloats = 12;     // of a splat's record, and of its gradient
constexpr int kMostPlainColors = 3;  // the record's fourth channel is the depth
constexpr int kViewSums = 15;        // gradient of a camera: rotation by rows, translation, centre

struct Scene {
  projection::ProjectionInput projection;  // of the first batch and camera
  const float* colors;                     // [batches or images, N, color_row]; null: not rendered
  const float* centers;                    // [images, 3], or null: of the view matrices
  const float* backgrounds;                // [images, channels without depth], or null: black
  int64_t gaussians;
  int32_t batches, cameras;
  int32_t degree;     // of the harmonics, or kPlainColors
  int32_t color_row;  // floats per Gaussian in `colors`
  int32_t channels;   // colours in the picture, 0 to 3
  bool depth;         // behind the colours, the sum of weight and z ...
  bool expected;      // ... divided by alpha
  bool colors_per_camera, antialiased;
  int32_t width, height, tile_width, tile_height;

  constexpr int64_t images() const { return int64_t(batches) * cameras; }
  constexpr int64_t tiles() const { return int64_t(tile_width) * tile_height; }                // of one image
  constexpr int64_t blocks() const { return blocks_for(gaussians, frame::kGaussianThreads); }  // of Gaussians, of one image
  constexpr int32_t image_channels() const { return channels + (depth ? 1 : 0); }
};

// The projected splats [images, N]; zero where culled. `opacities` is null unless antialiased, `records` are not written there.
struct Splats {
  float *means2d, *depths, *conics, *opacities;
  int32_t *radii, *tiles_per_gauss;
  float* records;  // [images, N, kSplatFloats]
};

// All lists, behind one another; lengths in instances.
struct Lists {
  int32_t* tile_offsets;     // [images * tiles]; scan writes one more, the length
  int32_t* splat_starts;     // [images * N + 1]
  uint64_t* keys;            // scratch: depth bits << 32 | instance
  int32_t* instance_splats;  // scratch: the splat of every instance, within its image
  int32_t* flatten_ids;      // by tile and depth: image * N + splat
  int64_t* isect_ids;        // by tile and depth: image | tile | depth bits, as gsplat has it
  int32_t* sorted;           // by tile and depth: the instance; null where no gradient is wanted
  int64_t length;
  int64_t tiles;  // of all images

  // Where the list of a tile begins, and behind the last tile where its list ends.
  __host__ __device__ int begin(int64_t tile) const { return tile < tiles ? tile_offsets[tile] : int(length); }
};

struct Pixels {
  float* image;   // [images, H, W, image_channels]
  float* alphas;  // [images, H, W]
  float* depths;  // [images, H, W]: expected depth, for the gradient; or null
  int32_t* last;  // [images, H, W]: position of the last instance blended, or -1; null where no gradient is wanted
};

void project(const Scene& scene, const Splats& out, const frame::Scratch& scratch, cudaStream_t stream);
// Offsets and starts of the lists; status[frame::kStatusNeeded] becomes their length. `scratch.block_counts` has one sum for each
// block of each image.
void scan(const Scene& scene, const Lists& lists, int32_t* status, const frame::Scratch& scratch, cudaStream_t stream);
void fill(const Scene& scene, const Splats& splats, const Lists& lists, const frame::Scratch& scratch, cudaStream_t stream);
void blend(const Scene& scene, const Splats& splats, const Lists& lists, const Pixels& out, cudaStream_t stream);

// One row per visible splat, in the order of image and Gaussian: what gsplat calls packed.
struct PackedSplats {
  int64_t *batch_ids, *camera_ids, *gaussian_ids;
  Splats rows;      // without records
  int32_t* row_of;  // [images, N]: the row of a splat, or -1
};
// `visible` [images * blocks of Gaussians + 1] gets how many rows there are in front of each block; their number is the last.
void count_visible(const Scene& scene, const Splats& splats, uint32_t* counts, cudaStream_t stream);
void pack(const Scene& scene, const Splats& splats, const int32_t* block_starts, const PackedSplats& out, cudaStream_t stream);
// `to` gets the rows of the splats in `from`.
void renumber(int64_t length, const int32_t* row_of, const int32_t* from, int32_t* to, cudaStream_t stream);

// From the picture's gradient to that of the splats.
struct PictureGradient {
  const float* v_image;   // or null: zero
  const float* v_alphas;  // or null: zero
  const float* alphas;    // these three of the forward pass
  const float* depths;
  const int32_t* last;
};
struct SplatSums {
  const float* conics;    // [rows, 3] of the forward pass
  const int32_t* row_of;  // [images, N], or null: row i is splat i
  float* v_splats;        // [images, N, kSplatFloats]: 6 moments, 4 channels, 2 sums of |dL/dmean|; zero where culled
  float* v_means2d;       // [rows, 2]
  float* v_absolute;      // [rows, 2], or null
};
void instance_gradients(const Scene& scene, const float* records, const Lists& lists, const PictureGradient& from, bool absolute,
                        float* rows, cudaStream_t stream);
void splat_gradients(const Scene& scene, const int32_t* splat_starts, const float* rows, const SplatSums& out,
                     cudaStream_t stream);

// From the splats' gradients to the inputs'. Null: none came, or none is wanted.
struct ProjectedGradients {
  const int32_t* radii;      // [images, N, 2]
  const int32_t* row_of;     // [images, N], or null: row i is splat i
  const float* v_splats;     // [images, N, kSplatFloats]
  const float* v_means2d;    // [rows, 2]
  const float* v_depths;     // [rows]
  const float* v_conics;     // [rows, 3]
  const float* v_opacities;  // [rows], where antialiased
};
struct InputGradients {
  float *means, *covars, *quats, *scales, *opacities, *colors;
  float* view_sums;  // scratch: [images, blocks of Gaussians, kViewSums]
  float* viewmats;   // [images, 4, 4], zero before
  float* centers;    // [images, 3]; null where they were computed from the matrices
};
void input_gradients(const Scene& scene, const ProjectedGradients& from, const InputGradients& to, cudaStream_t stream);

}  // namespace gsplat::rasterization
