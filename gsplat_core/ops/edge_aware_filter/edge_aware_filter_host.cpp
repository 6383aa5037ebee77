#include "edge_aware_filter.h"

#include <memory>

#include "host_call.h"

namespace gsplat::edge_aware_filter {
namespace {

#if defined(GSPLAT_CUDA)

void link(const Guide& guide, float* right, float* down, const CudaCall& call) {
  link_on_device(guide, right, down, call.stream);
}

void smooth(const Lines& lines, int64_t planes, int64_t plane_size, const CudaCall& call) {
  smooth_on_device(lines, planes, plane_size, call.stream);
}

#else

constexpr int64_t kGrainRows = 64, kGrainLines = 64;

void link(const Guide& guide, float* right, float* down, const CpuCall&) {
  torch::stable::parallel_for(0, guide.height, kGrainRows,
                              [&](int64_t begin, int64_t end) { kernels().link(guide, right, down, begin, end); });
}

void smooth(const Lines& lines, int64_t planes, int64_t plane_size, const CpuCall&) {
  const Kernels& k = kernels();
  for (int64_t plane = 0; plane < planes; ++plane) {
    Lines own = lines;
    own.plane += plane * plane_size;
    torch::stable::parallel_for(0, lines.count, kGrainLines, [&](int64_t begin, int64_t end) {
      const auto scratch = std::make_unique<float[]>(size_t(2 * lines.length * k.lanes));
      k.smooth(own, begin, end, scratch.get());
    });
  }
}

#endif

Tensor smooth_within_edges(Tensor planes, Tensor guide, double strength, double grey_step) {
  Call call(planes);
  const Tensor given = call.floats(planes, "planes"), seen = call.take(guide, ScalarType::Byte, "guide");
  check(given.dim() == 3, "planes must be [C, H, W]");
  const int64_t height = given.size(1), width = given.size(2), channels = seen.dim() == 3 ? seen.size(2) : 1;
  check((seen.dim() == 2 || seen.dim() == 3) && seen.size(0) == height && seen.size(1) == width && channels >= 1 &&
            channels <= kMostChannels,
        "guide must be [H, W] or [H, W, channels] with at most ", kMostChannels, " channels, and of the planes' size");
  check(height <= kMostLength && width <= kMostLength, "planes must have at most ", kMostLength, " pixels on a side, got ", width,
        " x ", height);
  check(strength >= 0 && grey_step > 0, "strength must not be negative and grey_step must be positive, got ", strength, " and ",
        grey_step);
  Tensor result = torch::stable::clone(given);
  if (result.numel() == 0) return result;
  Tensor right = call.empty({height, width}), down = call.empty({height, width});
  link({seen.const_data_ptr<uint8_t>(), int32_t(height), int32_t(width), int32_t(channels), float(1 / grey_step)},
       mutable_data(right), mutable_data(down), call);
  const Lines rows = {mutable_data(result), data(right), height, width, 1, width, 0};
  const Lines columns = {mutable_data(result), data(down), width, height, width, 1, 0};
  double current = strength;
  for (int round = 0; round < kRounds; ++round, current *= kAttenuation) {
    for (Lines lines : {rows, columns}) {
      lines.strength = float(current);
      smooth(lines, given.size(0), height * width, call);
    }
  }
  call.finish("smooth_within_edges");
  return result;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) { m.impl("smooth_within_edges", GSPLAT_BOX(&smooth_within_edges)); }

}  // namespace gsplat::edge_aware_filter
