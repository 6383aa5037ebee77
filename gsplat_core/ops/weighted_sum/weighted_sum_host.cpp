// Host code of weighted_sums and its gradient: checks, memory, and the launch on each device.
#include "weighted_sum.h"

#include <tuple>

#include "../compositing/tiled_splats.h"
#include "host_call.h"
#if !defined(GSPLAT_CUDA)
#include "../compositing/tile_pass.h"
#endif

namespace gsplat::weighted_sum {
namespace {

// Checked inputs of either pass. The tensors own the memory that `in` points to.
struct Arguments {
  compositing::TiledSplats splats;
  Tensor channels, weights;
  Inputs in;

  Arguments(const Call& call, const Tensor& means2d, const Tensor& conics, const Tensor& channels_, const Tensor& opacities,
            const Tensor& weights_, const Tensor& offsets, const Tensor& flatten_ids, int64_t width, int64_t height)
      : splats(call, "weighted_sums", means2d, conics, opacities, offsets, flatten_ids, width, height),
        channels(call.floats(channels_, "channels")),
        weights(call.floats(weights_, "weights")) {
    const compositing::Inputs& of = splats.in;
    check(channels.dim() == 2 && channels.size(0) == of.count, "weighted_sums: channels must be [", of.count, ", D]");
    check(channels.size(1) >= 1 && channels.size(1) <= kMostChannels, "weighted_sums takes 1 to ", kMostChannels,
          " channels, found ", channels.size(1));
    splats.check_rows("weighted_sums", "weights", weights, 1);
    check(width * height < compositing::kMostInts, "weighted_sums: more than 2^31 - 2 pixels");
    in = {.means2d = of.means2d,
          .conics = of.conics,
          .channels = data(channels),
          .opacities = of.opacities,
          .weights = data(weights),
          .offsets = of.offsets,
          .flatten_ids = of.flatten_ids,
          .count = of.count,
          .instances = of.instances,
          .channel_count = int32_t(channels.size(1)),
          .width = of.width,
          .height = of.height,
          .tile_width = of.tile_width,
          .tile_height = of.tile_height};
  }
};

#if defined(GSPLAT_CUDA)

void forward(Call& call, const Arguments& given, float* sums) { weighted_sums_on_device(given.in, sums, call.stream); }

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

void forward(Call& call, const Arguments& given, float* sums) {
  compositing::check_lists(given.splats.in);
  const Inputs& in = given.in;
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
  forward(call, arguments, mutable_data(sums));
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
