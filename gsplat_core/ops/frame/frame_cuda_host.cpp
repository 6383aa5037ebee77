// Host code of render_frame, render_weighted_frame and accumulate_status_: argument checks, memory and kernel launches.
#include <algorithm>
#include <tuple>

#include "frame_inputs.h"

namespace gsplat::frame {
namespace {

constexpr int64_t kMaxInts = (int64_t(1) << 31) - 1;
constexpr int64_t kFewTiles = 4096;  // up to this number of tiles every counter has its own 128 bytes

using Frame = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

void check_capacity(int64_t capacity, int64_t tiles, Mode mode) {
  if (mode == kSegments) {
    const int64_t most = std::min<int64_t>(kMaxSegment, kMaxInts / tiles);
    check(capacity > 0 && capacity <= most, "render_frame: a tile's segment must have a capacity of 1 to ", most,
          " instances with ", tiles, " tiles, got ", capacity);
  } else {
    check(capacity > 0 && capacity <= kMaxInts, "render_frame: capacity must be 1 to ", kMaxInts, " instances, got ", capacity);
  }
}

// Memory of a frame: its results other than the picture, and the kernels' scratch.
struct FrameMemory {
  Tensor records, tile_offsets, sorted, splat_starts, instance_splats, status;
  Lists lists;
  Scratch scratch;
  uint64_t* zeros;  // scratch that must be zero
  int64_t zero_count;

  FrameMemory(CudaCall& call, const Scene& in, int64_t capacity, Mode mode) {
    const bool training = mode == kTraining, segments = mode == kSegments;
    const int64_t tiles = in.tiles();
    check_capacity(capacity, tiles, mode);
    const auto ints = [&](int64_t when_training) { return call.empty({training ? when_training : 0}, ScalarType::Int); };
    records = call.empty({in.count, 12});
    tile_offsets = call.empty({segments ? 0 : tiles + 1}, ScalarType::Int);
    sorted = ints(capacity);
    splat_starts = ints(in.count + 1);
    instance_splats = ints(capacity);
    status = call.empty({kStatusSize}, ScalarType::Int);
    lists = {.records = records.mutable_data_ptr<float>(),
             .tile_offsets = segments ? nullptr : tile_offsets.mutable_data_ptr<int32_t>(),
             .keys = call.array<uint64_t>(segments ? tiles * capacity : capacity),
             .sorted = training ? sorted.mutable_data_ptr<int32_t>() : nullptr,
             .splat_starts = training ? splat_starts.mutable_data_ptr<int32_t>() : nullptr,
             .instance_splats = training ? instance_splats.mutable_data_ptr<int32_t>() : nullptr,
             .status = status.mutable_data_ptr<int32_t>(),
             .capacity = capacity,
             .segment = segments ? int32_t(capacity) : 0};
    const int64_t blocks = blocks_for(in.count, kGaussianThreads), states = scan_state_count(tiles, blocks);
    const int32_t stride = tiles <= kFewTiles ? 32 : 8;
    zero_count = states + tiles * stride / 2;
    zeros = call.array<uint64_t>(zero_count);
    scratch = {.footprints = segments ? nullptr : call.array<uint2>(in.count),
               .depths = segments ? nullptr : call.array<uint32_t>(in.count),
               .counters = reinterpret_cast<uint32_t*>(zeros + states),
               .scan_states = zeros,
               .block_counts = training ? call.array<uint32_t>(blocks) : nullptr,
               .block_starts = training ? call.array<uint32_t>(blocks) : nullptr,
               .counter_stride = stride};
  }

  void clear(CudaCall& call) const {
    check_cuda(cudaMemsetAsync(zeros, 0, size_t(zero_count) * sizeof(uint64_t), call.stream), "clearing the tile counters");
  }
};

Frame render_frame(std::vector<Tensor> gaussians, OptionalTensor deltas, Tensor viewmat, Tensor intrinsics,
                   OptionalTensor background, int64_t width, int64_t height, double eps2d, double near_plane, double far_plane,
                   int64_t camera_model, int64_t capacity, int64_t mode) {
  check(mode >= kShared && mode <= kSegments, "render_frame: mode must be 0 (shared), 1 (training) or 2 (segments), got ", mode);
  const bool training = mode == kTraining, segments = mode == kSegments;
  Inputs inputs(gaussians, deltas, viewmat, intrinsics, background, {width, height, eps2d, near_plane, far_plane, camera_model},
                !training);
  CudaCall& call = inputs.call;
  const Scene& in = inputs.scene;
  Tensor image = call.empty({height, width, 4}), alphas = call.empty({height, width});
  Tensor last = call.empty({training ? height : 0, training ? width : 0}, ScalarType::Int);
  const FrameMemory memory(call, in, capacity, Mode(mode));
  const Pixels out = {mutable_data(image), mutable_data(alphas), training ? last.mutable_data_ptr<int32_t>() : nullptr};
  memory.clear(call);
  preprocess(in, memory.lists, memory.scratch, call.stream);
  if (!segments) {
    scan(in, memory.lists, memory.scratch, call.stream);
    fill(in, memory.lists, memory.scratch, call.stream);
  } else if (in.count == 0) {
    check_cuda(cudaMemsetAsync(memory.lists.status, 0, kStatusSize * sizeof(int32_t), call.stream),
               "clearing the frame's status");
  }
  blend(in, memory.lists, memory.scratch, out, call.stream);
  call.finish("render_frame");
  return {
      image,        alphas, last, memory.records, memory.tile_offsets, memory.sorted, memory.splat_starts, memory.instance_splats,
      memory.status};
}

std::tuple<Tensor, Tensor, Tensor> render_weighted_frame(std::vector<Tensor> gaussians, Tensor opacity_harmonics, Tensor factors,
                                                         std::vector<Tensor> scalars, Tensor viewmat, Tensor intrinsics,
                                                         OptionalTensor background, int64_t width, int64_t height, double eps2d,
                                                         double near_plane, double far_plane, int64_t camera_model,
                                                         double least_total, double least_share, int64_t capacity) {
  Inputs inputs(gaussians, {}, viewmat, intrinsics, background, {width, height, eps2d, near_plane, far_plane, camera_model});
  CudaCall& call = inputs.call;
  const Scene& in = inputs.scene;
  opacity_harmonics = call.floats(opacity_harmonics, "opacity_harmonics");
  factors = call.floats(factors, "factors");
  check(opacity_harmonics.numel() == kOpacityBases * in.count && factors.numel() == in.count,
        "render_weighted_frame: opacity_harmonics must be [N, ", kOpacityBases, "] and factors [N] with N = ", in.count);
  check(scalars.size() == 3, "render_weighted_frame: scalars must be sigma, distance and behind; got ", scalars.size());
  for (Tensor& scalar : scalars) {
    scalar = call.floats(scalar, "scalars");
    check(scalar.numel() == 1, "render_weighted_frame: each of the scalars must be one number, got ", scalar.numel());
  }
  const Weighting weighting = {.opacity_harmonics = data(opacity_harmonics),
                               .factors = data(factors),
                               .sigma = data(scalars[0]),
                               .distance = data(scalars[1]),
                               .behind = data(scalars[2]),
                               .least_total = float(least_total),
                               .least_share = float(least_share),
                               .aligned = reinterpret_cast<uintptr_t>(opacity_harmonics.data_ptr()) % 16 == 0};
  Tensor image = call.empty({height, width, 4}), alphas = call.empty({height, width});
  const FrameMemory memory(call, in, capacity, kShared);
  memory.clear(call);
  preprocess_weighted(in, weighting, memory.lists, memory.scratch, call.stream);
  scan(in, memory.lists, memory.scratch, call.stream);
  fill(in, memory.lists, memory.scratch, call.stream);
  sum_weighted(in, weighting, memory.lists, {mutable_data(image), mutable_data(alphas), nullptr}, call.stream);
  call.finish("render_weighted_frame");
  return {image, alphas, memory.status};
}

Tensor accumulate_status_(Tensor status, Tensor totals, Tensor step) {
  CudaCall call(status);
  for (const Tensor* t : {&status, &totals}) {
    call.ints(*t, "accumulate_status_'s status");
    check(t->is_contiguous() && t->numel() == kStatusSize, "accumulate_status_: status and totals must be contiguous, with ",
          kStatusSize, " entries each, got ", t->numel());
  }
  call.take(step, ScalarType::Long, "step");
  check(step.numel() == 1, "accumulate_status_: step must be one number, got ", step.numel());
  Tensor fits = call.empty({1});
  accumulate_status(status.const_data_ptr<int32_t>(), totals.mutable_data_ptr<int32_t>(), step.mutable_data_ptr<int64_t>(),
                    mutable_data(fits), call.stream);
  call.finish("accumulate_status_");
  return fits;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("render_frame", GSPLAT_BOX(&render_frame));
  m.impl("render_weighted_frame", GSPLAT_BOX(&render_weighted_frame));
  m.impl("accumulate_status_", GSPLAT_BOX(&accumulate_status_));
}

}  // namespace gsplat::frame
