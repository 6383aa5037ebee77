#include "disparity_fit.h"

#include <cmath>
#include <memory>
#include <tuple>

#include "host_call.h"

namespace gsplat::disparity_fit {
namespace {

Taps gaussian() {
  double weights[kRadius + 1], total = 0;
  for (int k = 0; k <= kRadius; ++k) {
    weights[k] = std::exp(-0.5 * k * k / (double(kSigma) * kSigma));
    total += k == 0 ? weights[k] : 2 * weights[k];
  }
  Taps taps;
  for (int k = 0; k <= kRadius; ++k) taps.tap[k] = float(weights[k] / total);
  return taps;
}

#if defined(GSPLAT_CUDA)

void run(CudaCall& call, const Fit& fit) { fit_on_device(fit, call, call.stream); }

#else

constexpr int64_t kGrainRows = 32;

void run(CpuCall& call, const Fit& fit) {
  float* plane[Planes::kCount];
  for (float*& each : plane) each = call.array<float>(int64_t(fit.height) * fit.width);
  const Planes planes = {plane[0], plane[1], plane[2], plane[3], plane[4], plane[5], plane[6]};
  const Kernels& k = kernels();
  const auto for_rows = [&](const auto& work) {
    torch::stable::parallel_for(0, fit.height, kGrainRows, [&](int64_t begin, int64_t end) {
      const auto scratch = std::make_unique_for_overwrite<float[]>(size_t(3 * fit.width + 2 * kRadius));
      work(begin, end, scratch.get());
    });
  };
  for_rows([&](int64_t begin, int64_t end, float*) { k.prepare(fit, planes, begin, end); });
  for_rows([&](int64_t begin, int64_t end, float* scratch) { k.share(fit, planes, begin, end, scratch); });
  for (int step = 0; step < kSteps; ++step) {
    for_rows([&](int64_t begin, int64_t end, float*) { k.sample(fit, planes, begin, end); });
    for_rows([&](int64_t begin, int64_t end, float* scratch) { k.weigh(fit, planes, begin, end, scratch); });
    for_rows([&](int64_t begin, int64_t end, float* scratch) { k.move(fit, planes, step + 1 == kSteps, begin, end, scratch); });
  }
}

#endif

std::tuple<Tensor, Tensor> fit_disparities(Tensor left, Tensor right, Tensor sixteenths) {
  Call call(left);
  const Tensor here = call.take(left, ScalarType::Byte, "left"), there = call.take(right, ScalarType::Byte, "right");
  const Tensor start = call.ints(sixteenths, "sixteenths");
  check(here.dim() == 2, "left must be a picture [H, W]");
  for (const Tensor& other : {there, start})
    check(other.dim() == 2 && other.size(0) == here.size(0) && other.size(1) == here.size(1),
          "left, right and sixteenths must have one size [H, W]");
  check(here.size(0) <= kMostSide && here.size(1) <= kMostSide, "pictures must have at most ", kMostSide,
        " pixels on a side, got ", here.size(1), " x ", here.size(0));
  Tensor px = call.empty({here.size(0), here.size(1)}), error_px = call.empty({here.size(0), here.size(1)});
  Fit fit = {};
  fit.left = here.const_data_ptr<uint8_t>(), fit.right = there.const_data_ptr<uint8_t>();
  fit.sixteenths = start.const_data_ptr<int32_t>();
  fit.px = mutable_data(px), fit.error_px = mutable_data(error_px);
  fit.height = int32_t(here.size(0)), fit.width = int32_t(here.size(1)), fit.taps = gaussian();
  if (here.numel() > 0) run(call, fit);
  call.finish("fit_disparities");
  return {px, error_px};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) { m.impl("fit_disparities", GSPLAT_BOX(&fit_disparities)); }

}  // namespace gsplat::disparity_fit
