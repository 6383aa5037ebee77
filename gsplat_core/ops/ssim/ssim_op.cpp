#include <cmath>
#include <vector>

#include "cpu_call.h"
#include "ssim.h"

static void fill_taps(float* taps) {
  double weights[kSsimTaps], total = 0;
  for (int k = 0; k < kSsimTaps; ++k) {
    const double offset = (k - kSsimRadius) / 1.5;  // sigma 1.5 px
    total += weights[k] = std::exp(-0.5 * offset * offset);
  }
  for (int k = 0; k < kSsimTaps; ++k) taps[k] = float(weights[k] / total);
}

void run_ssim(SsimTask& task) {
  fill_taps(task.taps);
  // A band recomputes two radii of rows, so it should be several times as high.
  constexpr int64_t kBandRows = 48;
  torch::stable::parallel_for(0, task.height, kBandRows, [&](int64_t begin, int64_t end) {
    thread_local std::vector<float> scratch(kSsimScratchFloats);
    for (int64_t strip = 0; strip < ssim_strips(task.width, task.channels); ++strip)
      ssim_kernels().band(task, strip, begin, end, scratch.data());
  });
}

static SsimTask image_task(const Tensor& image, const Tensor& target) {
  check(image.dim() == 3 && target.dim() == 3, "image and target must be [H, W, C]");
  for (int d = 0; d < 3; ++d) check(image.size(d) == target.size(d), "image and target must have one shape");
  check(image.size(2) >= 1 && image.size(2) <= kSsimMaxChannels, "image must have 1 to 32 channels");
  SsimTask task{};
  task.image = data(image);
  task.target = data(target);
  task.height = image.size(0);
  task.width = image.size(1);
  task.channels = int(image.size(2));
  task.scale = 1;
  return task;
}

static Tensor ssim_map(Tensor image, Tensor target) {
  const Tensor x = floats(image, "image"), y = floats(target, "target");
  SsimTask task = image_task(x, y);
  Tensor map = empty_floats({task.height, task.width, task.channels});
  task.map = mutable_data(map);
  run_ssim(task);
  return map;
}

static Tensor ssim_map_backward(Tensor gradient, Tensor image, Tensor target) {
  const Tensor g = floats(gradient, "gradient"), x = floats(image, "image"), y = floats(target, "target");
  SsimTask task = image_task(x, y);
  check(g.numel() == x.numel(), "the gradient must have the map's shape");
  Tensor result = zero_floats({task.height, task.width, task.channels});
  task.upstream = data(g);
  task.gradient = mutable_data(result);
  run_ssim(task);
  return result;
}

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CPU, m) {
  m.impl("ssim_map", GSPLAT_BOX(&ssim_map));
  m.impl("ssim_map_backward", GSPLAT_BOX(&ssim_map_backward));
}
