#include <numeric>
#include <optional>
#include <tuple>
#include <vector>

#include "../ssim/ssim.h"
#include "cpu_call.h"
#include "image_loss.h"

constexpr int64_t kRows = 16;  // rows a thread takes at least

static Tensor bytes(const Tensor& t, const char* name) {
  check(t.is_cpu(), name, " must be on the CPU for this implementation");
  check(t.scalar_type() == ScalarType::Byte, name, " must be uint8");
  return t.is_contiguous() ? t : torch::stable::contiguous(t);
}

// Rows in order, whichever thread summed them.
template <typename T>
static T total(const std::vector<T>& rows) {
  return std::accumulate(rows.begin(), rows.end(), T(0));
}

static double depth_term(const Tensor& depth, const Tensor& target, const uint8_t* mask, double weight, Tensor& gradient) {
  const int64_t height = depth.size(0), width = depth.size(1);
  std::vector<double> sums(height);
  std::vector<int64_t> counts(height);
  DepthTask task{data(depth), data(target), mask, mutable_data(gradient), 0, sums.data(), counts.data(), width};
  torch::stable::parallel_for(0, height, kRows,
                              [&](int64_t begin, int64_t end) { image_loss_kernels().count_depth_rows(task, begin, end); });
  const double valid = double(total(counts));
  task.scale = valid > 0 ? float(weight / valid) : 0;
  torch::stable::parallel_for(0, height, kRows,
                              [&](int64_t begin, int64_t end) { image_loss_kernels().depth_rows(task, begin, end); });
  return valid > 0 ? total(sums) / valid : 0;
}

static std::tuple<Tensor, Tensor, Tensor, Tensor> image_loss(Tensor image, Tensor target, std::optional<Tensor> mask,
                                                             std::optional<Tensor> depth, std::optional<Tensor> target_depth,
                                                             double ssim_weight, double depth_weight) {
  const Tensor x = floats(image, "image");
  const bool is_bytes = target.scalar_type() == ScalarType::Byte;
  const Tensor y = is_bytes ? bytes(target, "target") : floats(target, "target");
  check(x.dim() == 3 && y.dim() == 3 && x.numel() == y.numel(), "image and target must be [H, W, C] of one shape");
  const int64_t height = x.size(0), width = x.size(1), channels = x.size(2), pixels = height * width;
  check(channels >= 1 && channels <= kSsimMaxChannels, "image must have 1 to 32 channels");
  const Tensor m = mask ? bytes(*mask, "mask") : x;
  check(!mask || m.numel() == pixels, "mask must be [H, W]");
  const uint8_t* tissue = mask ? m.const_data_ptr<uint8_t>() : nullptr;
  const double values = double(channels * (tissue ? image_loss_kernels().count_tissue(tissue, pixels) : pixels));

  Tensor grad_image = empty_floats({height, width, channels});
  std::vector<double> sums(height);
  const L1Task l1{data(x),
                  is_bytes ? nullptr : data(y),
                  is_bytes ? y.const_data_ptr<uint8_t>() : nullptr,
                  tissue,
                  mutable_data(grad_image),
                  values > 0 ? float((1 - ssim_weight) / values) : 0,
                  sums.data(),
                  width,
                  int(channels)};
  torch::stable::parallel_for(0, height, kRows,
                              [&](int64_t begin, int64_t end) { image_loss_kernels().l1_rows(l1, begin, end); });
  const double l1_term = values > 0 ? total(sums) / values : 0;

  double ssim_term = 0;
  if (ssim_weight != 0 && values > 0) {
    std::vector<double> strips(height * ssim_strips(width, int(channels)));
    SsimTask ssim{};
    ssim.image = l1.image, ssim.target = l1.target, ssim.target_bytes = l1.target_bytes, ssim.mask = tissue;
    ssim.scale = float(-ssim_weight / values);
    ssim.gradient = l1.gradient, ssim.sums = strips.data();
    ssim.height = height, ssim.width = width, ssim.channels = int(channels);
    run_ssim(ssim);
    ssim_term = total(strips) / values;
  }

  Tensor grad_depth = empty_floats({0});
  double inverse_depth_term = 0;
  if (depth) {
    check(target_depth.has_value(), "depth needs target_depth");
    const Tensor z = floats(*depth, "depth"), target_z = floats(*target_depth, "target_depth");
    check(z.dim() == 2 && z.size(0) == height && z.size(1) == width && target_z.numel() == pixels,
          "depth and target_depth must be [H, W]");
    grad_depth = empty_floats({height, width});
    inverse_depth_term = depth_term(z, target_z, tissue, depth_weight, grad_depth);
  }

  Tensor loss = empty_floats({}), terms = empty_floats({3});
  *mutable_data(loss) = float((1 - ssim_weight) * l1_term + ssim_weight * ssim_term + depth_weight * inverse_depth_term);
  float* t = mutable_data(terms);
  t[0] = float(l1_term), t[1] = float(ssim_term), t[2] = float(inverse_depth_term);
  return {loss, terms, grad_image, grad_depth};
}

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CPU, m) { m.impl("image_loss", GSPLAT_BOX(&image_loss)); }
