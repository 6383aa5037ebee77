// Stochastic transparency and Gaussian point splatting: random samples of a scene without sorting. Interface between the
// host code and the kernels of both devices.
//
// A frame buffer holds one 64-bit word for each sub-pixel and slot: the bits of z in the upper half, the splat's row in
// the lower one. Every fragment or point takes the minimum with its own word, so the order of the work has no influence.
#pragma once

#include <cstdint>

#include "constants.h"
#include "cuda_stream.h"
#include "isa.h"

namespace gsplat::stochastic {

enum Method : int32_t {
  kFragments = 0,  // every covered sub-pixel draws against its alpha (StochasticSplats, ICCV 2025)
  kPoints = 1      // every splat draws a Poisson number of points (Rijsdijk et al. 2026)
};

constexpr int kMaxSlots = 4;         // samples per pass; one call of the random generator gives as many numbers
constexpr int kInlineFragments = 4;  // splats with at most so many fragments are drawn without the queue
constexpr int kChunk = 4096;         // splats that share the ranges of quantised values
constexpr int kColourChunk = 256;    // splats that share the range of quantised colours
constexpr int kChunkFloats = 20 + 6 * (kChunk / kColourChunk);  // floats per chunk: see quantised.h
constexpr uint64_t kEmpty = ~uint64_t(0);
constexpr int64_t kMaxSubpixels = int64_t(1) << 31;

// Geometry of N splats in one of three formats: `packed` if given, otherwise covariances if given, otherwise raw
// rotations and log-scales.
struct Scene {
  const float* means;        // [N, 3]
  const float* covars;       // [N, 6]
  const float* opacities;    // [N], with `covars`
  const float* quats;        // [N, 4], wxyz of any length
  const float* log_scales;   // [N, 3]
  const float* logits;       // [N], with `quats`
  const float* sh;           // [N, bases, 3]; null if packed
  const int32_t* index;      // [N] index of each row in the file, which selects its random numbers; null: the row
  const uint32_t* packed;    // [N, 4]
  const float* chunks;       // [ceil(N / kChunk), kChunkFloats], with `packed`
  const uint8_t* packed_sh;  // [N, bases - 1, 3], with `packed`; null for one basis
  int64_t count;
  int32_t bases, degree;
};

struct Request {
  const float* viewmat;     // [4, 4] world to camera
  const float* intrinsics;  // [3, 3] in pixels
  int32_t width, height;    // in pixels
  int32_t camera_model;
  int32_t supersampling;  // sub-pixels per pixel and axis
  int32_t method;
  int32_t pixel_order;  // 1 to order by the plane of each splat; only kFragments with a pinhole camera
  int32_t slots;        // samples of this pass: 1 or kMaxSlots
  uint32_t sample;      // first sample; a multiple of kMaxSlots unless slots = 1
  uint32_t active;      // bit k: slot k is drawn
  uint32_t seed[2];

  constexpr int32_t columns() const { return width * supersampling; }
  constexpr int32_t rows() const { return height * supersampling; }
  constexpr int64_t subpixels() const { return int64_t(columns()) * rows(); }
};

// Projected splat, with the number of fragments or points to draw for it.
struct alignas(16) Splat {
  float u, v, z;   // centre in pixels, camera z
  float conic[3];  // log2(e) / 2 times the coefficients of x^2, 2 xy and y^2
  float log2_opacity;
  // kFragments: 1 / z of the plane at (x, y) is the product with (x, y, 1). kPoints: upper Cholesky factor of the inverse
  // covariance (11, 12, 22).
  float plane[3];
  uint32_t row, key;  // key: index in the file
  uint32_t corner;    // first column and row of sub-pixels, 16 bits each
  uint32_t size;      // columns and rows minus 1, 16 bits each
  uint32_t count;     // fragments or points
  // kFragments: largest distance of the plane's depth from z. kPoints: dilogarithm of the opacity, or -1 if each fragment
  // draws its own points.
  float extra;
};
static_assert(sizeof(Splat) == 64);

// CPU kernels.
struct Kernels {
  // Projects rows `begin` to `end` - 1, writes the visible splats with at least one fragment or point, and returns their
  // number.
  int64_t (*project)(const Scene&, const Request&, int64_t begin, int64_t end, Splat* out);
  // Draws the fragments or points `begin` to `end` - 1 of `splats`, whose first ones are numbered starts[0..count].
  void (*draw)(const Request&, const Splat* splats, const int64_t* starts, int64_t count, int64_t begin, int64_t end,
               uint64_t* frame);
  // Adds red, green, blue, hits and z of the pixels of rows `begin` to `end` - 1 to `sums` [H, W, 5].
  void (*resolve)(const Scene&, const Request&, const uint64_t* frame, float* sums, int64_t begin, int64_t end);
  // Writes `count` Poisson numbers for each of `rates` as out[rate, count]. The index of the rate is their random key.
  void (*poisson)(const double* rates, int64_t rate_count, int64_t count, uint64_t seed, int64_t* out);
};

// Memory for splats with many fragments on CUDA. `splats` has room for `capacity` large splats, and `starts` for as
// many numbers. `rounds` is zeroed and has ceil(count / capacity) values.
struct Queue {
  Splat* splats;
  uint64_t* starts;
  unsigned long long* rounds;
  int64_t capacity;
};
void draw_on_device(const Scene& scene, const Request& view, const Queue& queue, uint64_t* frame, cudaStream_t stream);
void resolve_on_device(const Scene& scene, const Request& view, const uint64_t* frame, float* sums, cudaStream_t stream);
void poisson_on_device(const double* rates, int64_t rate_count, int64_t count, uint64_t seed, int64_t* out, cudaStream_t stream);

// Return the capacity of the queue in splats, at least 1 and less than 2^21. It is limited by `bytes` of memory and by
// the 42 bits that count the fragments of all splats in the queue.
constexpr int64_t most_in_queue(int64_t bytes, int64_t subpixels) {
  const int64_t by_memory = bytes / int64_t(sizeof(Splat) + sizeof(uint64_t));
  const int64_t by_bits = (int64_t(1) << 42) / (2 * (subpixels > 64 ? subpixels : 64));
  const int64_t most = by_memory < by_bits ? by_memory : by_bits;
  const int64_t limit = (int64_t(1) << 21) - 1;
  return most < 1 ? 1 : (most < limit ? most : limit);
}

}  // namespace gsplat::stochastic

GSPLAT_KERNELS(stochastic, Kernels)
