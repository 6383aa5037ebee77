#include "ssim.h"

#include <cmath>
#include <numeric>
#include <vector>

#include "host_call.h"

namespace gsplat::ssim {

#if !defined(GSPLAT_CUDA)

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
  // Height of the bands of rows that threads process. A band recomputes two radii of rows, so its height should be
  // several times larger.
  constexpr int64_t kBandRows = 48;
  torch::stable::parallel_for(0, task.height, kBandRows, [&](int64_t begin, int64_t end) {
    thread_local std::vector<float> scratch(kSsimScratchFloats);
    for (int64_t strip = 0; strip < ssim_strips(task.width, task.channels); ++strip)
      kernels().band(task, strip, begin, end, scratch.data());
  });
}

#endif

namespace {

// Two checked images of the same size.
struct Images {
  Tensor image, target;
  int64_t height, width, channels;

  Images(const Call& call, const Tensor& image_, const Tensor& target_)
      : image(call.floats(image_, "image")), target(call.floats(target_, "target")) {
    check(image.dim() == 3 && target.dim() == 3, "image and target must be [H, W, C]");
    for (int d = 0; d < 3; ++d)
      check(image.size(d) == target.size(d), "image and target must have one shape, got ", image.size(d), " and ", target.size(d),
            " along dimension ", d);
    height = image.size(0), width = image.size(1), channels = image.size(2);
    check(channels >= 1 && channels <= kSsimMaxChannels, "image must have 1 to ", kSsimMaxChannels, " channels, got ", channels);
  }
};

#if defined(GSPLAT_CUDA)
using Task = DeviceSsim;
#else
using Task = SsimTask;
#endif

Task task_of(const Images& images) {
  Task task = {};
#if defined(GSPLAT_CUDA)
  check(images.height <= kSsimMostRows && images.width <= kSsimMostRows, "image must have at most ", kSsimMostRows,
        " pixels on a side, got ", images.width, " x ", images.height);
  task.stride = int32_t(images.channels);
#endif
  task.image = data(images.image), task.target = data(images.target), task.scale = 1;
  task.height = decltype(task.height)(images.height), task.width = decltype(task.width)(images.width);
  task.channels = int(images.channels);
  return task;
}

// Set the border of a task; returns the number of values that are not in it.
double set_border(Task& task, int64_t border) {
  check(border >= 0 && 2 * border < task.height && 2 * border < task.width, "a border of ", border, " pixels leaves none of ",
        task.width, " x ", task.height);
  task.border = decltype(task.border)(border);
  return double(task.height - 2 * border) * double(task.width - 2 * border) * task.channels;
}

void run(Call& call, Task& task) {
#if defined(GSPLAT_CUDA)
  ssim_on_device(task, call, call.stream);
#else
  (void)call;
  run_ssim(task);
#endif
}

Tensor ssim_map(Tensor image, Tensor target) {
  Call call(image);
  const Images images(call, image, target);
  Tensor map = call.empty({images.height, images.width, images.channels});
  Task task = task_of(images);
  task.map = mutable_data(map);
  run(call, task);
  call.finish("ssim_map");
  return map;
}

Tensor ssim_map_backward(Tensor gradient, Tensor image, Tensor target) {
  Call call(image);
  const Images images(call, image, target);
  const Tensor upstream = call.floats(gradient, "gradient");
  check(upstream.numel() == images.image.numel(), "the gradient must have the map's ", images.image.numel(), " values, got ",
        upstream.numel());
  Tensor result = call.zeros({images.height, images.width, images.channels});
  Task task = task_of(images);
  task.upstream = data(upstream), task.gradient = mutable_data(result);
  run(call, task);
  call.finish("ssim_map_backward");
  return result;
}

Tensor ssim_mean(Tensor image, Tensor target, int64_t border) {
  Call call(image);
  const Images images(call, image, target);
  Task task = task_of(images);
  const double values = set_border(task, border);
  Tensor mean = call.empty({});
#if defined(GSPLAT_CUDA)
  ssim_mean_on_device(task, values, mutable_data(mean), call, call.stream);
#else
  std::vector<double> strips(size_t(task.height * ssim_strips(task.width, task.channels)));
  task.sums = strips.data();
  run_ssim(task);
  *mutable_data(mean) = float(1 - std::accumulate(strips.begin(), strips.end(), 0.0) / values);
#endif
  call.finish("ssim_mean");
  return mean;
}

Tensor ssim_mean_backward(Tensor gradient, Tensor image, Tensor target, int64_t border) {
  Call call(image);
  const Images images(call, image, target);
  const Tensor upstream = call.floats(gradient, "gradient");
  check(upstream.numel() == 1, "the gradient must be that of the mean, 1 value, got ", upstream.numel());
  Task task = task_of(images);
  const double values = set_border(task, border);
  Tensor result = call.zeros({images.height, images.width, images.channels});
  task.gradient = mutable_data(result);
#if defined(GSPLAT_CUDA)
  task.scale = float(1 / values), task.factor = data(upstream);
#else
  task.scale = float(double(*data(upstream)) / values);
#endif
  run(call, task);
  call.finish("ssim_mean_backward");
  return result;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("ssim_map", GSPLAT_BOX(&ssim_map));
  m.impl("ssim_map_backward", GSPLAT_BOX(&ssim_map_backward));
  m.impl("ssim_mean", GSPLAT_BOX(&ssim_mean));
  m.impl("ssim_mean_backward", GSPLAT_BOX(&ssim_mean_backward));
}

}  // namespace gsplat::ssim
