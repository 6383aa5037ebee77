#include "../compositing/gather_rows.cuh"
#include "../compositing/row_sums.cuh"
#include "../compositing/warp_sums.cuh"
#include "cuda_scratch.h"
#include "world_blending_math.h"

namespace gsplat::world_blending {
namespace {

using namespace GSPLAT_ISA::world_blending;
using compositing::Instances;

constexpr int kChannelsAtOnce = 8;          // in registers of the forward pass; further ones repeat it over the list
constexpr int kStaged = kWindow * kWindow;  // Gaussians in shared memory, and threads of a block
constexpr int kWarpsEach = kStaged / 32;
constexpr int kBatch = 32;  // Gaussians per step of the backward pass

// The window of 16x16 pixels of a thread block, and the pixel of a thread. The host does not check the lists: positions are
// clamped here, and ids out of range are skipped.
struct Place {
  int64_t tile, image, pixel, begin, end;  // the list of the tile
  int window;                              // number of the window in the tile
  bool inside, masked;
  const float* gaussians;

  __device__ explicit Place(const Inputs& in) {
    const int across = (in.tile_size + kWindow - 1) / kWindow, windows = across * across;
    const int64_t tiles = int64_t(in.tile_width) * in.tile_height;
    tile = blockIdx.x / windows, image = tile / tiles, window = int(blockIdx.x % windows);
    const int place = int(tile % tiles);
    const int in_x = window % across * kWindow + int(threadIdx.x) % kWindow;
    const int in_y = window / across * kWindow + int(threadIdx.x) / kWindow;
    const int x = place % in.tile_width * in.tile_size + in_x, y = place / in.tile_width * in.tile_size + in_y;
    inside = in_x < in.tile_size && in_y < in.tile_size && x < in.width && y < in.height;
    pixel = (image * in.height + y) * in.width + x;
    masked = in.masks != nullptr && !in.masks[tile];
    const int64_t first = in.offsets[tile], next = tile + 1 < tiles * in.images ? in.offsets[tile + 1] : in.instances;
    begin = first < 0 ? 0 : first > in.instances ? in.instances : first;
    end = next < begin ? begin : next > in.instances ? in.instances : next;
    gaussians = in.gaussians + image / in.cameras * in.count * kGaussianNumbers;
  }
};

// Gaussian at a position of the list in shared memory: id or -1, numbers and opacity.
__device__ inline void stage(const Inputs& in, const Place& place, int64_t position, float* numbers, int32_t& id) {
  id = position < place.end ? in.flatten_ids[position] : -1;
  if (id < 0 || id >= in.count * in.images) id = -1;
  for (int k = 0; k < kGaussianNumbers && id >= 0; ++k)
    numbers[k] = place.gaussians[int64_t(id) % in.count * kGaussianNumbers + k];
  numbers[kGaussianNumbers] = id < 0 ? 0 : in.opacities[id];
}

__device__ inline float alpha_of(const float* staged, const Passing& p) {
  return staged[kGaussianNumbers] * exp2f(log2_response(p.squared));
}

__global__ void __launch_bounds__(kStaged) blend(Inputs in, Pixels out, int first_channel) {
  __shared__ float staged[kStaged][kGaussianNumbers + 1];
  __shared__ int32_t ids[kStaged];
  const Place place(in);
  const int64_t end = place.masked ? place.begin : place.end;
  float ray[kRayNumbers] = {}, check = 0;
  if (place.inside)
    for (int k = 0; k < kRayNumbers; ++k) ray[k] = in.rays[place.pixel * kRayNumbers + k], check += 0.0f * ray[k];
  bool open = place.inside && check == 0.0f;
  float through = 1, sum[kChannelsAtOnce] = {};
  int last = -1;
  const int channels = ::min(in.channels - first_channel, kChannelsAtOnce);
  for (int64_t first = place.begin; first < end; first += kStaged) {
    if (__syncthreads_count(open) == 0) break;
    stage(in, place, first + threadIdx.x, staged[threadIdx.x], ids[threadIdx.x]);
    __syncthreads();
    const int count = int(end - first < kStaged ? end - first : kStaged);
    for (int i = 0; i < count && open; ++i) {
      if (ids[i] < 0) continue;
      const float alpha = GSPLAT_ISA::min(alpha_of(staged[i], passing(staged[i], ray)), in.max_alpha);
      if (!(alpha >= gsplat::kAlphaCutoff)) continue;
      const float next = through * (1 - alpha);
      if (!(next > gsplat::kMinTransmittance)) {
        open = false;
        break;
      }
      const float* const color = in.colors + int64_t(ids[i]) * in.channels + first_channel;
      for (int d = 0; d < kChannelsAtOnce; ++d)
        if (d < channels) sum[d] += alpha * through * color[d];
      through = next;
      last = int(first + i);
    }
    __syncthreads();
  }
  if (!place.inside) return;
  if (first_channel == 0) out.through[place.pixel] = through, out.last[place.pixel] = last;
  for (int d = 0; d < kChannelsAtOnce; ++d)
    if (d < channels) out.colors[place.pixel * in.channels + first_channel + d] = sum[d];
}

constexpr int sums_of(int channels) { return kMoments + channels; }
constexpr int passes_of(int sums) { return (sums + 15) / 16; }

// Gradients by V colour channels from `first_channel` on, and by the transmittance if that is 0. They are linear in the
// gradients of the results, so that those of several launches add up. `rows` holds sums_of(V) floats per instance and
// window. A block adds the sums of its warps; there are no atomic additions, so that results are bitwise reproducible.
template <int V>
__global__ void __launch_bounds__(kStaged)
    blend_backward(Inputs in, PixelGradients from, int first_channel, float* rows, float* v_rays) {
  constexpr int kSums = sums_of(V), kPasses = passes_of(kSums);
  __shared__ float staged[kBatch][kGaussianNumbers + 1];
  __shared__ float staged_colors[kBatch][V];
  __shared__ int32_t ids[kBatch];
  __shared__ float sums[kWarpsEach][kBatch][16 * kPasses + 1];  // padded against bank conflicts
  __shared__ int furthest;
  const Place place(in);
  const int lane = threadIdx.x & 31, warp = threadIdx.x / 32, channels = ::min(in.channels - first_channel, V);
  const int across = (in.tile_size + kWindow - 1) / kWindow, windows = across * across;
  const auto row_of = [&](int64_t position) { return rows + (position * windows + place.window) * kSums; };
  float ray[kRayNumbers] = {}, v_ray[kRayNumbers] = {}, v_color[V] = {}, through = 1, behind = 0;
  int last = -1;
  if (place.inside) {
    last = from.last[place.pixel];
    through = from.through[place.pixel];
    if (first_channel == 0) behind = through * from.v_through[place.pixel];
    // A pixel without a ray (NaN, outside of the lens) has no Gaussian. It gets a ray of 0, because NaN would spread.
    for (int k = 0; k < kRayNumbers && last >= 0; ++k) ray[k] = in.rays[place.pixel * kRayNumbers + k];
    for (int d = 0; d < V; ++d)
      if (d < channels) v_color[d] = from.v_colors[place.pixel * in.channels + first_channel + d];
  }
  if (threadIdx.x == 0) furthest = -1;
  __syncthreads();
  const int warp_furthest = __reduce_max_sync(0xffffffffu, last);
  if (lane == 0) atomicMax(&furthest, warp_furthest);
  __syncthreads();
  const int64_t end = furthest < place.begin ? place.begin : furthest + 1 < place.end ? furthest + 1 : place.end;
  // Rows of instances that reach no pixel, and before the first tile of those that no list contains.
  for (int64_t e = threadIdx.x; e < (place.end - end) * kSums; e += kStaged) row_of(end + e / kSums)[e % kSums] = 0;
  if (place.tile == 0)
    for (int64_t e = threadIdx.x; e < place.begin * kSums; e += kStaged) row_of(e / kSums)[e % kSums] = 0;
  for (int64_t stop = end; stop > place.begin; stop -= kBatch) {
    const int64_t first = stop - kBatch > place.begin ? stop - kBatch : place.begin;
    const int count = int(stop - first);
    __syncthreads();
    if (int(threadIdx.x) < count) {
      int32_t& id = ids[threadIdx.x];
      stage(in, place, first + threadIdx.x, staged[threadIdx.x], id);
      for (int d = 0; d < V; ++d)
        staged_colors[threadIdx.x][d] = id >= 0 && d < channels ? in.colors[int64_t(id) * in.channels + first_channel + d] : 0;
    }
    for (int e = threadIdx.x; e < kWarpsEach * kBatch * (16 * kPasses + 1); e += kStaged) (&sums[0][0][0])[e] = 0;
    __syncthreads();
    for (int i = count - 1; i >= 0; --i) {
      if (ids[i] < 0 || first + i > warp_furthest) continue;
      Passing p = passing(staged[i], ray);
      const float unlimited = alpha_of(staged[i], p), alpha = GSPLAT_ISA::min(unlimited, in.max_alpha);
      const bool hit = first + i <= last && alpha >= gsplat::kAlphaCutoff;
      if (!__any_sync(0xffffffffu, hit)) continue;
      float v[16 * kPasses] = {};
      if (hit) {
        const float widen = 1 / (1 - alpha), before = through * widen, weight = alpha * before;
        float g = 0;
#pragma unroll
        for (int d = 0; d < V; ++d) {
          g = fmaf(v_color[d], staged_colors[i][d], g);
          v[kMoments + d] = weight * v_color[d];
        }
        const float v_alpha = fmaf(before, g, -(behind * widen));
        through = before;
        behind = fmaf(weight, g, behind);
        // Where alpha is clamped to its maximum, opacity and shape have no gradient.
        if (unlimited <= in.max_alpha) add_moments(staged[i], p, ray, alpha * v_alpha, v, v_ray);
      }
#pragma unroll
      for (int pass = 0; pass < kPasses; ++pass) {
        const float total = compositing::warp_sums<8>(v + 16 * pass, lane);
        if ((lane & 1) == 0) sums[warp][i][16 * pass + lane / 2] = total;
      }
    }
    __syncthreads();
    for (int e = threadIdx.x; e < count * kSums; e += kStaged) {
      const int i = e / kSums, r = e % kSums;
      float total = 0;
      for (int k = 0; k < kWarpsEach; ++k) total += sums[k][i][r];
      row_of(first + i)[r] = total;
    }
  }
  if (!place.inside) return;
  float* const to = v_rays + place.pixel * kRayNumbers;
  for (int k = 0; k < kRayNumbers; ++k) to[k] = (first_channel == 0 ? 0 : to[k]) + v_ray[k];
}

// Convert each Gaussian's sums over pixels to gradients, in one launch per group of channels. The first launch
// (first_channel = 0) overwrites the gradients of the Gaussian and its opacity, and later launches add to them.
__global__ void convert_sums(Inputs in, const float* sums, int row_size, int first_channel, InputGradients out) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= in.count * in.images) return;
  const float* const own = sums + i * row_size;
  const float* const gaussian = in.gaussians + (i / in.count / in.cameras * in.count + i % in.count) * kGaussianNumbers;
  float v_gaussian[kGaussianNumbers], v_opacity;
  gaussian_gradients(own, gaussian, in.opacities[i], v_gaussian, &v_opacity);
  const bool add = first_channel > 0;
  float* const to = out.gaussians + i * kGaussianNumbers;
  for (int k = 0; k < kGaussianNumbers; ++k) to[k] = (add ? to[k] : 0) + v_gaussian[k];
  out.opacities[i] = (add ? out.opacities[i] : 0) + v_opacity;
  for (int d = 0; d < row_size - kMoments; ++d)
    if (first_channel + d < in.channels) out.colors[i * in.channels + first_channel + d] = own[kMoments + d];
}

// Call run with the number of channels of one launch as a compile-time constant: the smallest of 3, 8 and kMostChannels
// that is sufficient for `channels`, or kMostChannels if several launches are needed.
template <class Run>
void with_channels(int channels, const Run& run) {
  if (channels <= 3) return run(std::integral_constant<int, 3>());
  if (channels <= 8) return run(std::integral_constant<int, 8>());
  run(std::integral_constant<int, kMostChannels>());
}

int64_t blocks_of(const Inputs& in) { return int64_t(in.images) * in.tile_width * in.tile_height * in.windows(); }

}  // namespace

void blend_on_device(const Inputs& in, const Pixels& out, cudaStream_t stream) {
  const int64_t blocks = blocks_of(in);
  if (blocks == 0) return;
  for (int channel = 0; channel == 0 || channel < in.channels; channel += kChannelsAtOnce)
    blend<<<unsigned(blocks), kStaged, 0, stream>>>(in, out, channel);
}

void blend_backward_on_device(const Inputs& in, const PixelGradients& from, const InputGradients& out, CudaScratch& scratch,
                              cudaStream_t stream) {
  const int64_t blocks = blocks_of(in), windows = in.windows(), count = in.count * in.images;
  compositing::Inputs lists = {};
  lists.flatten_ids = in.flatten_ids, lists.count = count, lists.instances = blocks > 0 ? in.instances : 0;
  const Instances instances = compositing::by_splat(lists, scratch, stream);
  const int widest = in.channels <= 3 ? 3 : in.channels <= 8 ? 8 : kMostChannels;
  float* const rows = scratch.array<float>(in.instances * windows * sums_of(widest));
  float* const sums = scratch.array<float>(count * sums_of(widest));
  for (int channel = 0; channel == 0 || channel < in.channels; channel += kMostChannels)
    with_channels(in.channels - channel, [&](auto number) {
      constexpr int V = decltype(number)::value, kRow = sums_of(V);
      if (blocks > 0) blend_backward<V><<<unsigned(blocks), kStaged, 0, stream>>>(in, from, channel, rows, out.rays);
      if (count == 0) return;
      compositing::sum_rows<<<blocks_for(count * kRow), kThreads, 0, stream>>>(count, instances.positions, instances.ranges, rows,
                                                                               int(windows), kRow, sums);
      convert_sums<<<blocks_for(count), kThreads, 0, stream>>>(in, sums, kRow, channel, out);
    });
}

}  // namespace gsplat::world_blending
