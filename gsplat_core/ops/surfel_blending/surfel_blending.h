// Alpha compositing of surfels (flat Gaussians) at the intersections of each pixel's ray with their planes (Huang et al.
// 2024), forward and backward: interface between the host code and the kernels of both devices.
//
// A ray transform maps the point (u, v, 1) of a surfel, in standard deviations, to homogeneous pixels. The intersection of
// the ray of a pixel is (u, v) = (q_0 / q_2, q_1 / q_2), where q is linear in the pixel: the record of a surfel holds its
// coefficients. With d the distance in pixels from the projected centre, sigma = min(u^2 + v^2, 2 d^2) / 2.
#pragma once

#include <cstdint>

#include "../compositing/compositing.h"

namespace gsplat::surfel_blending {

constexpr float kScreenFactor = 2;  // of the squared distance in pixels, which bounds the size of a surfel from below
constexpr int kMaxChannels = 16;    // colours; Python splits more of them into several calls
constexpr int kNormal = 3;          // numbers of a normal, the first values of a surfel
// Sums over the pixels of a surfel: alpha dL/dalpha; dL/dq, and the same times dx and times dy (9 numbers); dL/d(centre)
// by the screen-space distance, divided by kScreenFactor (2 numbers); dL/d(last colour channel) by distortion and median.
constexpr int kMoments = 13;
constexpr int kScreenMoments = 10, kDepthMoment = 12;

// Compiled number of channels that is sufficient for `channels`.
constexpr int padded_channels(int channels) {
  return channels <= 1 ? 1 : channels <= 3 ? 3 : channels <= 4 ? 4 : channels <= 8 ? 8 : kMaxChannels;
}

struct Inputs {
  compositing::Inputs splats;  // without conics
  const float* transforms;     // [count, 3, 3]
  const float* normals;        // [count, 3]
};

// One surfel prepared for blending, on one cache line.
struct alignas(64) Record {
  float x, y;  // projected centre in pixels
  float l;     // log2 of the opacity; -infinity for an unusable surfel
  float q[9];  // q at the centre, and its derivatives by x and by y; scaled by a factor
};
static_assert(sizeof(Record) == 64);

// Ellipse that contains all pixels where alpha may reach 1/255, as a splat: its alpha is 1/255 on the outline. The conic is 0
// if it contains all pixels.
struct Bound {
  float x, y, conic[3];
};

struct Pixels {
  float* colors;       // [images, height, width, channels]
  float* alphas;       // [images, height, width], as the following
  float* normals;      // with 3 values each
  float* distortions;  // sum over pairs of surfels of w_i w_j |z_i - z_j|, z being the last channel in ascending order
  float* medians;      // last channel of the last surfel in front of which the transmittance exceeds 1/2, or 0
  float* depth_sums;   // sum of weight times (last channel - that of the tile's first surfel)
  int32_t* last;       // position in flatten_ids of the last blended surfel, or -1
  int32_t* median_at;  // position of the median's surfel, or -1
};

// Inputs of the backward pass: results of the forward pass, and gradients of the loss.
struct PixelGradients {
  const float *alphas, *depth_sums;
  const int32_t *last, *median_at;
  const float *v_colors, *v_alphas, *v_normals, *v_distortions, *v_medians;
};

struct InputGradients {
  float* means2d;      // [count, 2]
  float* transforms;   // [count, 3, 3]
  float* colors;       // [count, channels]
  float* opacities;    // [count]
  float* normals;      // [count, 3]
  float* densify;      // [count, 2]: gradient of the centre in the image plane, times the depth
  float* backgrounds;  // [images, channels] or null
  float* absolute;     // [count, 2] or null: sums of |dL/dmeans2d|
};

// CPU: surfels prepared for blending.
struct Surfels : Inputs {
  const Record* records;                   // [count]
  const compositing::SplatRecord* bounds;  // [count]: `Bound`, with the opacity of the surfel
  const float* values;                     // [count, kNormal + padded channels]: normal, colours, zeros
};

struct GradientRows {
  const int32_t* row_of;  // row of every position in flatten_ids
  float* rows;            // [instances, row_size]: moments, values, then |dL/dx|, |dL/dy| with absgrad
  int64_t row_size;
  bool absgrad;
  float* v_backgrounds;  // [tiles, channels] partial sums, or null
};

struct Kernels {
  // Prepares the surfels [begin, end) for blending: their records, bounds and values.
  void (*records)(const Inputs& in, int64_t begin, int64_t end, Record* records, compositing::SplatRecord* bounds, float* values);
  void (*tile)(const Surfels& in, int64_t tile, const Pixels& out);
  void (*tile_backward)(const Surfels& in, int64_t tile, const PixelGradients& from, const GradientRows& out);
  // Sums the rows [first[i], first[i + 1]) of each surfel and converts them to gradients, for surfels [begin, end).
  void (*gather)(const Surfels& in, const GradientRows& from, const int32_t* first, int64_t begin, int64_t end,
                 const InputGradients& out);
};

// Blending of surfels on CUDA, forward and backward; all pointers are device memory.
void blend_on_device(const Inputs& in, const Pixels& out, CudaScratch& scratch, cudaStream_t stream);
void blend_backward_on_device(const Inputs& in, const PixelGradients& from, const InputGradients& out, CudaScratch& scratch,
                              cudaStream_t stream);

}  // namespace gsplat::surfel_blending

GSPLAT_KERNELS(surfel_blending, Kernels)
