// The fused frame path on CUDA: what the ops' host code asks of the kernels. All pointers are to device memory.
//
// Raw Gaussians become a picture in four launches, without a wait of the host: preprocess (deform, activate, project, colour,
// count tiles), scan, fill (one key per splat and tile), and per tile sort and blend. Where every tile has a room of its own for
// its list, preprocess writes the lists at once, and it takes two launches. The gradient takes two: per tile one row
// per instance, then per splat the sum of its rows and the way back to the raw parameters. Instances of a splat are numbered in
// the order of the splats, so a splat's rows lie together and every sum has one fixed order.
#pragma once

#include <cuda_runtime.h>

#include "cuda_scratch.h"
#include "raw_layout.h"

constexpr int kFrameTile = 16;      // pixels on a side
constexpr int kFrameThreads = 128;  // of a block that does one Gaussian per thread
constexpr int kRowQuads = 3;        // float4s of an instance's gradient row: 6 moments, 4 channels, 2 unused
constexpr int kStatusNeeded = 0;    // instances that the frame needs
constexpr int kStatusMost = 1;      // most instances in one tile
constexpr int kStatusCut = 2;       // 1 where they did not fit and some were left out
constexpr int kStatusWords = 4;
constexpr int kMostInTile = 1024;  // for which tiles can have rooms of their own
constexpr int kMostTilesAcross = 1 << 13;

// One camera's view of N Gaussians.
struct FrameScene {
  const float *means, *quats, *log_scales, *logit_opacities;  // [N, 3], [N, 4], [N, 3], [N]
  const float* sh;                                            // [N, bases, 3]; half precision where half_sh
  const float* deltas;                                        // [N, kRawColumns], or null
  const float *viewmat, *intrinsics;                          // [4, 4], [3, 3]
  const float* background;                                    // [3], or null: black
  int64_t count;
  int32_t bases, sh_degree;
  int32_t width, height, tile_width, tile_height;
  float eps2d, near_plane, far_plane;
  int32_t camera_model;
  bool aligned;  // quats, sh and deltas begin at a multiple of 16 bytes
  bool half_sh;  // then the picture is blended in half precision, too; not for training

  constexpr int64_t tiles() const { return int64_t(tile_width) * tile_height; }
};

// All tiles' lists behind each other in one room, of splats or, when training, of instances; or each in a room of its own.
enum ListKind { kShared, kTraining, kPerTile };

// What the forward pass leaves behind: records, and for every tile its instances in depth order. A list that was cut may hold
// -1: no instance.
struct FrameLists {
  void* records;                    // Record<4> [N]: colours are red, green, blue, z; of culled Gaussians not written
  int32_t* tile_offsets = nullptr;  // [tiles + 1]; null where tiles have rooms of their own
  uint64_t* keys = nullptr;  // [capacity], scratch: depth bits << 32 | splat, or instance when training; [tiles, tile_capacity]
  int32_t* sorted;           // [capacity], training: instances by tile and depth
  int32_t* splat_starts;     // [N + 1], training: where each splat's instances start; otherwise null
  int32_t* instance_splats;  // [capacity], training: the splat of every instance
  int32_t* status;           // [kStatusWords]
  int64_t capacity;
  int32_t tile_capacity = 0;  // 0: lists of any length, in one room

  constexpr ListKind kind() const { return splat_starts != nullptr ? kTraining : tile_capacity > 0 ? kPerTile : kShared; }
};

// On the way from one kernel to the next. Preprocess counts a tile's instances in the tile's slot; where tiles have no rooms of
// their own, the scan puts there where they start, and the fill counts on from there. Slots lie apart, because atomics on words
// of the same 32 or 128 bytes wait for each other.
struct FrameScratch {
  uint2* footprints;  // [N], see frame_footprint.cuh; like depths null where tiles have rooms of their own
  uint32_t* depths;   // [N], z of visible Gaussians as bits
  uint32_t* slots;    // [tiles, slot_stride], zero before
  uint64_t* states;   // [scan_states], zero before
  uint32_t* sums;     // [blocks of Gaussians], training: instances of each block
  uint32_t* starts;   // [blocks of Gaussians], training: where they start
  int32_t slot_stride;
};
constexpr int kScanThreads = 1024;
constexpr int64_t scan_states(int64_t tiles, int64_t blocks) { return tiles / kScanThreads + blocks / kScanThreads + 2; }

struct FramePixels {
  float* image;   // [H, W, 4]: colours, and the sum of z (training) or its mean over the splats, weighted by their contribution
  float* alphas;  // [H, W]
  int32_t* last;  // [H, W], training: the position in `sorted` of the last instance that was blended, or -1
};

void preprocess_frame(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch, cudaStream_t stream);
void scan_frame(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch, cudaStream_t stream);
void fill_frame(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch, cudaStream_t stream);
void blend_frame(const FrameScene& in, const FrameLists& lists, const FrameScratch& scratch, const FramePixels& out,
                 cudaStream_t stream);
