// Fused CUDA path from raw Gaussians to an image: launch functions for the op's host code. Pointers are device memory.
//
// A frame takes four launches and never makes the host wait: preprocess (deform, activate, project, colour, count
// tiles), scan (prefix sums of the counts), fill (one key per splat and tile), blend (sort and composite each tile). If
// every tile has a fixed segment of the key buffer, preprocess writes the keys itself and two launches suffice. The
// gradient takes two more launches (../frame_gradients): one row of sums per instance, then per splat the sum of its
// rows and the chain rule to its raw parameters.
//
// An instance is a pair of a splat and a tile that it touches. Instances are numbered splat by splat, so the rows of a
// splat are contiguous and every sum has a fixed order.
#pragma once

#include <cuda_runtime.h>

#include "cuda_scratch.h"
#include "raw_layout.h"

namespace gsplat::frame {

constexpr int kTile = 16;                 // pixels per side
constexpr int kGaussianThreads = 128;     // threads per block of kernels with one Gaussian per thread
constexpr int kRowQuads = 3;              // float4s per gradient row of an instance: 6 moments, 4 channels, 2 unused
constexpr int kMaxSegment = 1024;         // maximum capacity of a tile's segment
constexpr int kMaxTilesAcross = 1 << 13;  // tile coordinates are packed into 13 bits

// Indices into the status of a frame, which reports whether its tile lists overflowed.
constexpr int kStatusNeeded = 0;    // instances required by the frame
constexpr int kStatusLongest = 1;   // instances of the longest tile list
constexpr int kStatusOverflow = 2;  // 1 if the capacity was exceeded and instances were dropped
constexpr int kStatusSize = 4;

// Layout of the tile lists. kShared: lists of any length, concatenated in one buffer. kTraining: as kShared, with
// instance numbers instead of splat indices. kSegments: one fixed segment of equal capacity per tile.
enum Mode { kShared = 0, kTraining = 1, kSegments = 2 };

// One camera's view of N Gaussians.
struct Scene {
  const float *means, *quats, *log_scales, *logit_opacities;  // [N, 3], [N, 4], [N, 3], [N]
  const float* sh;                                            // [N, bases, 3]; __half if half_sh
  const float* deltas;                                        // [N, kRawColumns] or null
  const float *viewmat, *intrinsics;                          // [4, 4], [3, 3]
  const float* background;                                    // [3] or null: black
  int64_t count;
  int32_t bases, sh_degree;
  int32_t width, height, tile_width, tile_height;
  float eps2d, near_plane, far_plane;
  int32_t camera_model;
  bool aligned;  // quats, sh and deltas are aligned to 16 bytes
  bool half_sh;  // sh is half precision, and so is blending; not for training

  constexpr int64_t tiles() const { return int64_t(tile_width) * tile_height; }
};

// Values of a frame of weighted sums in addition to those of a `Scene`, see render_weighted_frame. The scalars are read on
// the device.
struct Weighting {
  const float* opacity_harmonics;  // [N, kOpacityBases]
  const float* factors;            // [N]: v_i
  const float *sigma, *distance;   // weight of a splat: v_i max(0, 1 - z / sigma); depths are added in units of `distance`
  const float* behind;             // weight of the background
  float least_total, least_share;  // lower limit of a pixel's weights; smallest sum of the splats' weights with a depth
  bool aligned;                    // opacity_harmonics is aligned to 16 bytes
};
constexpr int kOpacityDegree = 3, kOpacityBases = 16;
// Fixed point of weighted sums: a splat's term at a pixel times its channel, with at most kTermBits and kChannelBits binary
// places. A splat's largest term is limited to kMostTerm, its channels to kMostChannel.
constexpr int kTermBits = 24, kChannelBits = 18;
constexpr float kMostTerm = 127.0f, kMostChannel = 2048.0f;

// Results of the forward pass other than the image. After an overflow a list may contain -1: no instance.
struct Lists {
  void* records;                    // Record<4> [N] with colours red, green, blue, z; rows of culled Gaussians are not written
  int32_t* tile_offsets = nullptr;  // [tiles + 1]; null with segments
  uint64_t* keys = nullptr;         // scratch [capacity] or [tiles, segment]: depth bits << 32 | splat (instance when training)
  int32_t* sorted;                  // [capacity], training: instances ordered by tile and depth
  int32_t* splat_starts;            // [N + 1], training, else null: first instance of each splat
  int32_t* instance_splats;         // [capacity], training: splat of each instance
  int32_t* status;                  // [kStatusSize]
  int64_t capacity;
  int32_t segment = 0;  // capacity of a tile's segment; 0: lists share one buffer

  constexpr Mode mode() const { return splat_starts != nullptr ? kTraining : segment > 0 ? kSegments : kShared; }
};

// Scratch between the kernels of one frame. Preprocess counts each tile's instances in its counter. Without segments
// the scan replaces the count by the start of the tile's list, and fill increments it from there. Counters are spread
// out in memory, because atomics on the same 32-byte sector or 128-byte line are serialised.
struct Scratch {
  uint2* footprints;       // [N], see instances.cuh; null with segments, like depths
  uint32_t* depths;        // [N], bits of z of visible Gaussians
  uint32_t* counters;      // [tiles, counter_stride], zeroed
  uint64_t* scan_states;   // [scan_state_count], zeroed
  uint32_t* block_counts;  // [blocks of Gaussians], training: instances per block
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

// The first and last step of a frame of weighted sums, with shared lists (kShared) whose order does not matter. The colours
// of the records are in fixed point, the fifth is the splat's factor of exp2(power).
void preprocess_weighted(const Scene& in, const Weighting& weighting, const Lists& lists, const Scratch& scratch,
                         cudaStream_t stream);
void sum_weighted(const Scene& in, const Weighting& weighting, const Lists& lists, const Pixels& out, cudaStream_t stream);

// Accumulate a frame's status in `totals` [kStatusSize]: the maximum of every entry, except that overflowed frames are
// counted. If the frame did not overflow, increment `step` and set `fits` to 1, otherwise set `fits` to 0.
void accumulate_status(const int32_t* status, int32_t* totals, int64_t* step, float* fits, cudaStream_t stream);

}  // namespace gsplat::frame
