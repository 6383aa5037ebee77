// Host code of weighted_sums and its gradient: checks, memory, and the launch on each device.
#include <algorithm>
#include <tuple>

#include "host_call.h"
#include "weighted_sum.h"

namespace gsplat::weighted_sum {
namespace {

constexpr int64_t kMaxInts = (int64_t(1) << 31) - 1;

// Checked inputs of either pass. The tensors own the memory that `in` points to.
struct Arguments {
  Tensor means2d, conics, channels, opacities, weights, offsets, flatten_ids;
  Inputs in;

  Arguments(const Call& call, const Tensor& means2d_, const Tensor& conics_, const Tensor& channels_, const Tensor& opacities_,
            const Tensor& weights_, const Tensor& offsets_, const Tensor& flatten_ids_, int64_t width, int64_t height)
      : means2d(call.floats(means2d_, "means2d")),
        conics(call.floats(conics_, "conics")),
        channels(call.floats(channels_, "channels")),
        opacities(call.floats(opacities_, "opacities")),
        weights(call.floats(weights_, "weights")),
        offsets(call.ints(offsets_, "isect_offsets")),
        flatten_ids(call.ints(flatten_ids_, "flatten_ids")) {
    const int64_t count = opacities.numel();
    check(offsets.dim() == 2 && channels.dim() == 2 && channels.size(0) == count && means2d.numel() == 2 * count &&
              conics.numel() == 3 * count && weights.numel() == count,
          "weighted_sums takes means2d [N, 2], conics [N, 3], channels [N, D], opacities [N], weights [N] and isect_offsets "
          "[tile_height, tile_width]");
    check(channels.size(1) >= 1 && channels.size(1) <= kMostChannels, "weighted_sums takes 1 to ", kMostChannels,
          " channels, found ", channels.size(1));
    const int64_t tile_height = offsets.size(0), tile_width = offsets.size(1);
    check(width >= 0 && height >= 0 && width < kMaxInts && height < kMaxInts && width * height < kMaxInts &&
              tile_width * kTileSize >= width && tile_height * kTileSize >= height && tile_width * tile_height < kMaxInts,
          "weighted_sums: the tiles of isect_offsets, of 16 pixels, do not cover the image");
    check(count < kMaxInts && flatten_ids.numel() <= kMaxInts, "weighted_sums: more than 2^31 - 1 splats or instances");
    in = {.means2d = data(means2d),
          .conics = data(conics),
          .channels = data(channels),
          .opacities = data(opacities),
          .weights = data(weights),
          .offsets = offsets.const_data_ptr<int32_t>(),
          .flatten_ids = flatten_ids.const_data_ptr<int32_t>(),
          .count = count,
          .instances = flatten_ids.numel(),
          .channel_count = int32_t(channels.size(1)),
          .width = int32_t(width),
          .height = int32_t(height),
          .tile_width = int32_t(tile_width),
          .tile_height = int32_t(tile_height)};
  }
};

#if defined(GSPLAT_CUDA)

void forward(Call& call, const Inputs& in, float* sums) { weighted_sums_on_device(in, sums, call.stream); }

void backward(Call& call, const Inputs& in, const float* v_sums, const InputGradients& out) {
  weighted_sums_backward_on_device(in, v_sums, out, call.stream);
}

#else

constexpr int64_t kGrain = 256;  // minimum splats per task

SplatRecord* records_of(Call& call, const Inputs& in) {
  SplatRecord* const records = call.array<SplatRecord>(in.count);
  torch::stable::parallel_for(0, in.count, 2048, [&](int64_t begin, int64_t end) { kernels().records(in, begin, end, records); });
  return records;
}

// Validate the caller's lists; an out-of-range index would read outside of the tensors.
void check_lists(const Inputs& in) {
  const int64_t tiles = int64_t(in.tile_width) * in.tile_height;
  int32_t before = 0;
  bool ordered = true;
  for (int64_t i = 0; i < tiles; ++i) ordered &= in.offsets[i] >= before, before = in.offsets[i];
  check(ordered && before <= in.instances, "isect_offsets must rise from 0 to at most the length of flatten_ids");
  uint32_t most = 0;
  const int64_t first = tiles > 0 ? in.offsets[0] : in.instances;
  for (int64_t i = first; i < in.instances; ++i) most = std::max(most, uint32_t(in.flatten_ids[i]));
  check(first == in.instances || most < in.count, "flatten_ids must be in [0, ", in.count, "), found ", int32_t(most));
}

void forward(Call& call, const Inputs& in, float* sums) {
  check_lists(in);
  const SplatRecord* const records = records_of(call, in);
  torch::stable::parallel_for(0, int64_t(in.tile_width) * in.tile_height, 1, [&](int64_t begin, int64_t end) {
    for (int64_t tile = begin; tile < end; ++tile) kernels().tile(in, records, tile, sums);
  });
}

void backward(Call& call, const Inputs& in, const float* v_sums, const InputGradients& out) {
  const SplatRecord* const records = records_of(call, in);
  torch::stable::parallel_for(0, in.count, kGrain,
                              [&](int64_t begin, int64_t end) { kernels().backward(in, records, v_sums, begin, end, out); });
}

#endif

Tensor weighted_sums(Tensor means2d, Tensor conics, Tensor channels, Tensor opacities, Tensor weights, Tensor offsets,
                     Tensor flatten_ids, int64_t width, int64_t height) {
  Call call(means2d);
  const Arguments arguments(call, means2d, conics, channels, opacities, weights, offsets, flatten_ids, width, height);
  Tensor sums = call.empty({arguments.in.channel_count + 1, height, width});
  forward(call, arguments.in, mutable_data(sums));
  call.finish("weighted_sums");
  return sums;
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> weighted_sums_backward(Tensor means2d, Tensor conics, Tensor channels,
                                                                          Tensor opacities, Tensor weights, Tensor offsets,
                                                                          Tensor flatten_ids, int64_t width, int64_t height,
                                                                          Tensor v_sums_) {
  Call call(means2d);
  const Arguments arguments(call, means2d, conics, channels, opacities, weights, offsets, flatten_ids, width, height);
  const Inputs& in = arguments.in;
  const Tensor v_sums = call.floats(v_sums_, "v_sums");
  check(v_sums.numel() == (in.channel_count + 1) * width * height, "weighted_sums_backward takes v_sums [D + 1, H, W]");
  Tensor v_means2d = call.empty({in.count, 2}), v_conics = call.empty({in.count, 3});
  Tensor v_channels = call.empty({in.count, in.channel_count}), v_opacities = call.empty({in.count});
  Tensor v_weights = call.empty({in.count});
  backward(call, in, data(v_sums),
           {mutable_data(v_means2d), mutable_data(v_conics), mutable_data(v_channels), mutable_data(v_opacities),
            mutable_data(v_weights)});
  call.finish("weighted_sums_backward");
  return {v_means2d, v_conics, v_channels, v_opacities, v_weights};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("weighted_sums", GSPLAT_BOX(&weighted_sums));
  m.impl("weighted_sums_backward", GSPLAT_BOX(&weighted_sums_backward));
}

}  // namespace gsplat::weighted_sum
