#include <algorithm>
#include <string>
#include <tuple>

#include "frame_scene.h"

namespace {

constexpr int64_t kMostInts = (int64_t(1) << 31) - 1;
constexpr int64_t kFewTiles = 4096;  // for so many a slot may have 128 bytes

using Frame = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

Frame render_frame(Tensor means, Tensor quats, Tensor log_scales, Tensor logit_opacities, Tensor sh, std::optional<Tensor> deltas,
                   Tensor viewmat, Tensor intrinsics, std::optional<Tensor> background, int64_t width, int64_t height,
                   double eps2d, double near_plane, double far_plane, int64_t camera_model, int64_t capacity, bool per_tile,
                   bool training) {
  FrameInputs inputs(means, quats, log_scales, logit_opacities, sh, deltas, viewmat, intrinsics, background, width, height, eps2d,
                     near_plane, far_plane, camera_model, !training);
  CudaCall& call = inputs.call;
  const FrameScene& in = inputs.scene;
  const int64_t tiles = in.tiles(), most = per_tile ? std::min<int64_t>(kMostInTile, kMostInts / tiles) : kMostInts;
  check(!(training && per_tile), "render_frame: training numbers all instances, which needs per_tile=False");
  check(capacity > 0 && capacity <= most, "render_frame: capacity must be 1 to ", most, " instances",
        per_tile ? " in each of " : "", per_tile ? std::to_string(tiles) : "", per_tile ? " tiles" : "", ", got ", capacity);
  const auto ints = [&](int64_t when_training) { return call.empty({training ? when_training : 0}, ScalarType::Int); };
  Tensor image = call.empty({height, width, 4}), alphas = call.empty({height, width});
  Tensor last = call.empty({training ? height : 0, training ? width : 0}, ScalarType::Int);
  Tensor records = call.empty({in.count, 12}), tile_offsets = call.empty({per_tile ? 0 : tiles + 1}, ScalarType::Int);
  Tensor sorted = ints(capacity), splat_starts = ints(in.count + 1), instance_splats = ints(capacity);
  Tensor status = call.empty({kStatusWords}, ScalarType::Int);
  const FrameLists lists = {.records = records.mutable_data_ptr<float>(),
                            .tile_offsets = per_tile ? nullptr : tile_offsets.mutable_data_ptr<int32_t>(),
                            .keys = call.array<uint64_t>(per_tile ? tiles * capacity : capacity),
                            .sorted = training ? sorted.mutable_data_ptr<int32_t>() : nullptr,
                            .splat_starts = training ? splat_starts.mutable_data_ptr<int32_t>() : nullptr,
                            .instance_splats = training ? instance_splats.mutable_data_ptr<int32_t>() : nullptr,
                            .status = status.mutable_data_ptr<int32_t>(),
                            .capacity = capacity,
                            .tile_capacity = per_tile ? int32_t(capacity) : 0};
  const int64_t blocks = blocks_for(in.count, kFrameThreads), states = scan_states(tiles, blocks);
  const int32_t stride = tiles <= kFewTiles ? 32 : 8;
  uint64_t* const zeros = call.array<uint64_t>(states + tiles * stride / 2);
  const FrameScratch scratch = {.footprints = per_tile ? nullptr : call.array<uint2>(in.count),
                                .depths = per_tile ? nullptr : call.array<uint32_t>(in.count),
                                .slots = reinterpret_cast<uint32_t*>(zeros + states),
                                .states = zeros,
                                .sums = training ? call.array<uint32_t>(blocks) : nullptr,
                                .starts = training ? call.array<uint32_t>(blocks) : nullptr,
                                .slot_stride = stride};
  const FramePixels out = {mutable_data(image), mutable_data(alphas), training ? last.mutable_data_ptr<int32_t>() : nullptr};
  check_cuda(cudaMemsetAsync(zeros, 0, size_t(states + tiles * stride / 2) * sizeof(uint64_t), call.stream),
             "clearing the counts");
  preprocess_frame(in, lists, scratch, call.stream);
  if (!per_tile) {
    scan_frame(in, lists, scratch, call.stream);
    fill_frame(in, lists, scratch, call.stream);
  } else if (in.count == 0) {
    check_cuda(cudaMemsetAsync(lists.status, 0, kStatusWords * sizeof(int32_t), call.stream), "clearing the status");
  }
  blend_frame(in, lists, scratch, out, call.stream);
  check_cuda(cudaGetLastError(), "render_frame");
  return {image, alphas, last, records, tile_offsets, sorted, splat_starts, instance_splats, status};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) { m.impl("render_frame", GSPLAT_BOX(&render_frame)); }
