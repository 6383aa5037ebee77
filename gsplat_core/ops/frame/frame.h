// The fused frame path on CUDA: raw Gaussians to a picture. Launch functions for the op's host code; pointers are device memory.
//
// A frame takes four launches and never makes the host wait: preprocess (deform, activate, project, colour, count tiles), scan
// (prefix sums of the counts), fill (one key per splat and tile), blend (sort and composite each tile). When every tile has a
// fixed segment of the key buffer, preprocess writes the keys itself and two launches are enough. The gradient takes two more
// (../frame_gradients): one row of sums per instance, then per splat the sum of its rows and the chain rule back to its raw
// parameters.
//
// An instance is a pair of a splat and a tile it touches. Instances are numbered splat after splat, so the rows of a splat are
// contiguous and every sum has a fixed order.
#pragma once

#include <cuda_runtime.h>

#include "cuda_scratch.h"
#include "raw_layout.h"

namespace gsplat::frame {

constexpr int kTile = 16;                 // pixels on a side
constexpr int kGaussianThreads = 128;     // threads of a block that has one Gaussian per thread
constexpr int kRowQuads = 3;              // float4s of an instance's gradient row: 6 moments, 4 channels, 2 unused
constexpr int kMaxSegment = 1024;         // largest capacity of a tile's own segment
constexpr int kMaxTilesAcross = 1 << 13;  // tile coordinates are packed into 13 bits

// Entries of the frame's status.
constexpr int kStatusNeeded = 0;    // instances that the frame has
constexpr int kStatusLongest = 1;   // instances of the tile that has most
constexpr int kStatusOverflow = 2;  // 1 if they exceeded the capacity and some were left out
constexpr int kStatusSize = 4;

// How the tile lists are laid out. kShared: of any length, one after the other in one buffer. kTraining: likewise, of instance
// numbers instead of splat indices. kSegments: every tile has a segment of its own, of one capacity.
enum Mode { kShared = 0, kTraining = 1, kSegments = 2 };

// One camera's view of N Gaussians.
struct Scene {
  const float *means, *quats, *log_scales, *logit_opacities;  // [N, 3], [N, 4], [N, 3], [N]
  const float* sh;                                            // [N, bases, 3]; __half if half_sh
  const float* deltas;                                        // [N, kRawColumns], or null
  const float *viewmat, *intrinsics;                          // [4, 4], [3, 3]
  const float* background;                                    // [3], or null: black
  int64_t count;
  int32_t bases, sh_degree;
  int32_t width, height, tile_width, tile_height;
  float eps2d, near_plane, far_plane;
  int32_t camera_model;
  bool aligned;  // quats, sh and deltas are aligned to 16 bytes
  bool half_sh;  // then blending is in half precision, too; not for training

  constexpr int64_t tiles() const { return int64_t(tile_width) * tile_height; }
};

// Results of the forward pass besides the picture. A list that overflowed may contain -1: no instance.
struct Lists {
  void* records;                    // Record<4> [N]: colours are red, green, blue, z; rows of culled Gaussians are not written
  int32_t* tile_offsets = nullptr;  // [tiles + 1]; null with segments
  uint64_t* keys = nullptr;  // scratch: depth bits << 32 | splat, or instance when training; [capacity] or [tiles, segment]
  int32_t* sorted;           // [capacity], training: instances by tile and depth
  int32_t* splat_starts;     // [N + 1], training: first instance of each splat; otherwise null
  int32_t* instance_splats;  // [capacity], training: the splat of every instance
  int32_t* status;           // [kStatusSize]
  int64_t capacity;
  int32_t segment = 0;  // capacity of a tile's own segment; 0: lists share one buffer

  constexpr Mode mode() const { return splat_starts != nullptr ? kTraining : segment > 0 ? kSegments : kShared; }
};

// Scratch between the kernels of one frame. Preprocess counts a tile's instances in its counter; without segments the scan
// replaces the count by the start of the tile's list, and fill goes on counting from there. Counters are spread out in memory,
// because atomics on the same 32-byte sector or 128-byte line serialise.
struct Scratch {
  uint2* footprints;       // [N], see instances.cuh; like depths null with segments
  uint32_t* depths;        // [N], z of visible Gaussians as bits
  uint32_t* counters;      // [tiles, counter_stride], zeroed
  uint64_t* scan_states;   // [scan_state_count], zeroed
  uint32_t* block_counts;  // [blocks of Gaussians], training: instances of each block
  uint32_t* block_starts;  // [blocks of Gaussians], training: first instance of each block
  int32_t counter_stride;
};
constexpr int kScanThreads = 1024;
constexpr int64_t scan_state_count(int64_t tiles, int64_t blocks) { return tiles / kScanThreads + blocks / kScanThreads + 2; }

struct Pixels {
  float* image;   // [H, W, 4]: colours, and the weighted sum of z (training) or its weighted mean
  float* alphas;  // [H, W]
  int32_t* last;  // [H, W], training: position in `sorted` of the last blended instance, or -1
};

void preprocess(const Scene& in, const Lists& lists, const Scratch& scratch, cudaStream_t stream);
void scan(const Scene& in, const Lists& lists, const Scratch& scratch, cudaStream_t stream);
void fill(const Scene& in, const Lists& lists, const Scratch& scratch, cudaStream_t stream);
void blend(const Scene& in, const Lists& lists, const Scratch& scratch, const Pixels& out, cudaStream_t stream);

// Folds a frame's status into `totals` [kStatusSize], which has the maximum of every entry but for the number of overflowed
// frames. Unless the frame overflowed, `step` is incremented and `fits` set to 1; else `fits` is 0.
void accumulate_status(const int32_t* status, int32_t* totals, int64_t* step, float* fits, cudaStream_t stream);

}  // namespace gsplat::frame
