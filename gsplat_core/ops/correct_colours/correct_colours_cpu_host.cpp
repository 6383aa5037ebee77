// correct_colours on the CPU: argument checks, memory, and the loops over tiles and iterations.
#include "correct_colours.h"

#include <algorithm>
#include <vector>

#include "../compositing/alpha_limit.h"
#include "../compositing/tile_pass.h"
#include "../compositing/tiled_splats.h"
#include "host_call.h"

namespace gsplat::correct_colours {
namespace {

using compositing::InstanceRows;
using compositing::Line;
using compositing::SplatRecord;

constexpr int64_t kGrain = 2048;                           // minimum splats per task
constexpr int64_t kMostListed = 1LL << (31 - kBlockBits);  // splats of a tile whose codes fit into 32 bits

// Blending weights and targets of all tiles.
class AllWeights {
 public:
  AllWeights(const Splats& in, const Picture& picture)
      : in_(in),
        starts_(size_t(in.tiles()) + 1),
        pairs_(size_t(in.tiles())),
        first_(uninitialised<int32_t>(in.instances + in.tiles())),
        targets_(uninitialised<Line>(in.tiles() * kTargetFloats / kMostLanes)) {
    const Kernels& kernel = kernels();
    compositing::for_tiles(in.tiles(), 0, [&](int64_t tile, float*) { starts_[size_t(tile) + 1] = kernel.most_pairs(in, tile); });
    for (size_t tile = 0; tile < pairs_.size(); ++tile) starts_[tile + 1] += starts_[tile];
    const int64_t total = starts_.back();
    values_ = uninitialised<Line>(total * kernel.lanes / kMostLanes + 1);
    codes_ = uninitialised<int32_t>(2 * total);
    compositing::for_tiles(in.tiles(), 0,
                           [&](int64_t tile, float*) { pairs_[size_t(tile)] = kernel.weigh(in, tile, picture, of_tile(tile)); });
  }

  TileWeights of_tile(int64_t tile) const {
    const int64_t start = starts_[size_t(tile)];
    return {.values = values_[0].floats + start * kernels().lanes,
            .codes = codes_.get() + start,
            .order = codes_.get() + starts_.back() + start,
            .first = first_.get() + in_.offsets[tile] + tile,
            .target = targets_[0].floats + tile * kTargetFloats,
            .pairs = pairs_[size_t(tile)]};
  }

 private:
  const Splats& in_;
  std::vector<int64_t> starts_, pairs_;  // of each tile
  std::unique_ptr<Line[]> values_;
  std::unique_ptr<int32_t[]> codes_, first_;
  std::unique_ptr<Line[]> targets_;
};

// Check that no tile lists too many splats for the 32 bits of a pair's code.
void check_lengths(const Splats& in) {
  for (int64_t tile = 0; tile < in.tiles(); ++tile) {
    const int64_t listed = (tile + 1 < in.tiles() ? in.offsets[tile + 1] : in.instances) - in.offsets[tile];
    check(listed < kMostListed, "correct_colours: a tile has ", listed, " splats; it must be below ", kMostListed);
  }
}

// Return the corrected colours [N, 3].
Tensor correct_colours(Tensor means2d, Tensor conics, Tensor colors_, Tensor opacities, Tensor offsets, Tensor flatten_ids,
                       Tensor image_, Tensor mask_, int64_t steps, double relaxation, double least_weight, double max_alpha) {
  const Call call(means2d);
  const Tensor image = call.take(image_, ScalarType::Byte, "image"), mask = call.take(mask_, ScalarType::Byte, "mask");
  check(
      image.dim() == 3 && image.size(2) == 3 && mask.dim() == 2 && mask.size(0) == image.size(0) && mask.size(1) == image.size(1),
      "correct_colours: image must be [H, W, 3] and mask [H, W]");
  compositing::TiledSplats splats(call, "correct_colours", means2d, conics, opacities, offsets, flatten_ids, image.size(1),
                                  image.size(0), compositing::limit_of(max_alpha));
  const Tensor colors = call.floats(colors_, "colors");
  splats.check_rows("correct_colours", "colors", colors, 3);
  splats.in.colors = data(colors), splats.in.channels = 3;  // a splat with a colour that is not finite is not blended
  compositing::check_lists(splats.in);
  const int64_t count = splats.in.count;

  const auto records = uninitialised<SplatRecord>(count);
  const auto for_splats = [&](const auto& run) { torch::stable::parallel_for(0, count, kGrain, run); };
  for_splats([&](int64_t begin, int64_t end) { kernels().records(splats.in, begin, end, records.get()); });
  const Splats in = {splats.in, records.get()};
  check_lengths(in);

  Tensor corrected = call.empty({count, 3});
  float* const to = mutable_data(corrected);
  const auto shown = uninitialised<float>(count * kSums), shares = uninitialised<float>(count);
  for_splats([&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i)
      for (int d = 0; d < 3; ++d) to[3 * i + d] = in.colors[3 * i + d], shown[kSums * i + d] = std::max(to[3 * i + d], 0.0f);
  });
  if (steps == 0) return corrected;

  const AllWeights weights(in, {image.const_data_ptr<uint8_t>(), mask.const_data_ptr<uint8_t>()});
  const InstanceRows instances(in, 0);
  const auto rows = uninitialised<float>(in.instances * kSums);
  for (int64_t step = 0; step < steps; ++step) {
    compositing::for_tiles(in.tiles(), 0, [&](int64_t tile, float*) {
      kernels().sums(in, tile, weights.of_tile(tile), shown.get(), step == 0, instances.row_of.get(), rows.get());
    });
    for_splats([&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        float sum[kSums] = {};
        for (int64_t row = instances.first[i]; row < instances.first[i + 1]; ++row)
          for (int d = 0; d < kSums; ++d) sum[d] += rows[row * kSums + d];
        // Splats in no pixel of the mask keep their colours.
        if (step == 0) shares[i] = sum[3] > 0 ? float(relaxation) / (sum[3] + float(least_weight)) : 0;
        if (!(shares[i] > 0)) continue;
        for (int d = 0; d < 3; ++d) {
          float& color = to[3 * i + d];
          color += std::max(shares[i] * sum[d], -shown[kSums * i + d]);
          shown[kSums * i + d] = std::max(color, 0.0f);
        }
      }
    });
  }
  return corrected;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) { m.impl("correct_colours", GSPLAT_BOX(&correct_colours)); }

}  // namespace gsplat::correct_colours
