#include "stereo_matching.h"

#include <algorithm>
#include <memory>
#include <tuple>

#include "host_call.h"

namespace gsplat::stereo_matching {
namespace {

#if !defined(GSPLAT_CUDA)

constexpr int64_t kBandRows = 64;      // each band additionally computes the differences of eight rows
constexpr int64_t kBlockColumns = 64;  // columns per task

// Call work(begin, end, scratch) for blocks of `block` of the `items`, on torch's threads.
template <class Scratch, class Work>
void for_ranges(int64_t items, int64_t block, int64_t scratch_size, const Work& work) {
  torch::stable::parallel_for(0, (items + block - 1) / block, 1, [&](int64_t from, int64_t to) {
    const auto scratch = std::make_unique_for_overwrite<Scratch[]>(size_t(scratch_size));
    for (int64_t k = from; k < to; ++k) work(k * block, std::min((k + 1) * block, items), scratch.get());
  });
}

void match(CpuCall& call, const Pair& pair, const Matched& to) {
  const int64_t pixels = int64_t(pair.width) * pair.height;
  uint8_t* const costs = call.array<uint8_t>(pixels * pair.count);
  uint8_t* const messages = call.array<uint8_t>(pixels * pair.count);
  const Kernels& k = kernels();
  for_ranges<uint8_t>(pair.height, kBandRows, k.row_scratch(pair),
                      [&](int64_t begin, int64_t end, uint8_t* scratch) { k.rows(pair, costs, messages, begin, end, scratch); });
  for_ranges<uint8_t>(
      pair.width, kBlockColumns, k.column_scratch(pair, kBlockColumns),
      [&](int64_t begin, int64_t end, uint8_t* scratch) { k.columns(pair, costs, messages, begin, end, scratch); });
  for_ranges<uint32_t>(pair.height, kBandRows, pair.width, [&](int64_t begin, int64_t end, uint32_t* scratch) {
    k.winners(pair, costs, messages, to.sixteenths, begin, end, scratch);
  });
  k.drop_patches(pair, to.sixteenths, call.array<int32_t>(2 * pixels));
  for_ranges<int32_t>(pair.height, kBandRows, 3 * (pair.width + 2 * kJumpRadius),
                      [&](int64_t begin, int64_t end, int32_t* scratch) { k.surfaces(pair, to, begin, end, scratch); });
}

#else

void match(CudaCall& call, const Pair& pair, const Matched& to) { match_on_device(pair, to, call, call.stream); }

#endif

std::tuple<Tensor, Tensor> match_disparities(Tensor left, Tensor right, int64_t lowest, int64_t count) {
  Call call(left);
  const Tensor here = call.take(left, ScalarType::Byte, "left"), there = call.take(right, ScalarType::Byte, "right");
  check(here.dim() == 2 && there.dim() == 2 && here.size(0) == there.size(0) && here.size(1) == there.size(1),
        "left and right must be pictures [H, W] of one size");
  check(count > 0 && count <= kMostDisparities && count % kCountStep == 0, "count must be a multiple of ", kCountStep, " up to ",
        kMostDisparities, ", got ", count);
  check(lowest >= -kMostLowest && lowest <= kMostLowest, "lowest must be within ", kMostLowest, " pixels, got ", lowest);
  check(here.numel() <= kMostPixels && here.size(0) <= kMostSide && here.size(1) <= kMostSide, "pictures must have at most ",
        kMostPixels, " pixels, and ", kMostSide, " on a side, got ", here.size(1), " x ", here.size(0));
  const Pair pair = {here.const_data_ptr<uint8_t>(),
                     there.const_data_ptr<uint8_t>(),
                     int32_t(here.size(0)),
                     int32_t(here.size(1)),
                     int32_t(lowest),
                     int32_t(count)};
  Tensor sixteenths = call.empty({here.size(0), here.size(1)}, ScalarType::Int);
  Tensor one_surface = call.empty({here.size(0), here.size(1)}, ScalarType::Byte);
  if (here.numel() > 0) match(call, pair, {sixteenths.mutable_data_ptr<int32_t>(), one_surface.mutable_data_ptr<uint8_t>()});
  call.finish("match_disparities");
  return {sixteenths, one_surface};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) { m.impl("match_disparities", GSPLAT_BOX(&match_disparities)); }

}  // namespace gsplat::stereo_matching
