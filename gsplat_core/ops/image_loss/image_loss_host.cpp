#include "image_loss.h"

#include <numeric>
#include <tuple>
#include <vector>

#include "../ssim/ssim.h"
#include "host_call.h"

namespace gsplat::image_loss {
namespace {

// Checked images of one call. The tensors own the memory of the pointers.
struct Images {
  Tensor image, target;
  OptionalTensor mask, depth, target_depth;
  int64_t height, width, channels, pixels;  // `channels` of the target; the image may have more
  const float* target_values;               // null if the target is bytes
  const uint8_t *target_bytes, *tissue;

  Images(const Call& call, const Tensor& image_, const Tensor& target_, const OptionalTensor& mask_, const OptionalTensor& depth_,
         const OptionalTensor& target_depth_, int64_t extra_channels)
      : image(call.floats(image_, "image")),
        target(target_.scalar_type() == ScalarType::Byte ? call.take(target_, ScalarType::Byte, "target")
                                                         : call.floats(target_, "target")),
        mask(call.take_optional(mask_, ScalarType::Byte, "mask")),
        depth(call.floats(depth_, "depth")),
        target_depth(call.floats(target_depth_, "target_depth")) {
    check(image.dim() == 3 && target.dim() == 3, "image and target must be [H, W, C]");
    height = image.size(0), width = image.size(1), channels = image.size(2) - extra_channels, pixels = height * width;
    check(target.size(0) == height && target.size(1) == width && target.size(2) == channels, "the target must be [", height, ", ",
          width, ", ", channels, "] for this image, got [", target.size(0), ", ", target.size(1), ", ", target.size(2), "]");
    check(channels >= 1 && channels <= ssim::kSsimMaxChannels, "image must have 1 to ", ssim::kSsimMaxChannels, " channels, got ",
          channels);
    check_plane(mask, "mask");
    check_plane(depth, "depth");
    check_plane(target_depth, "target_depth");
    check(!depth.has_value() || target_depth.has_value(), "depth needs target_depth");
    const bool is_bytes = target.scalar_type() == ScalarType::Byte;
    target_values = is_bytes ? nullptr : data(target);
    target_bytes = is_bytes ? target.const_data_ptr<uint8_t>() : nullptr;
    tissue = mask.has_value() ? mask->const_data_ptr<uint8_t>() : nullptr;
  }

  void check_plane(const OptionalTensor& t, const char* name) const {
    check(!t.has_value() || t->numel() == pixels, name, " must be [H, W] with ", pixels, " pixels");
  }
};

struct Weights {
  double ssim, depth;
  bool squared;
};

// Return values of image_loss: loss, its terms [3], and its gradients by image and depth.
struct Results {
  Tensor loss, terms, v_image, v_depth;
};

#if defined(GSPLAT_CUDA)

DeviceImageLoss device_loss(const Images& in, const Weights& weights, const Results& out) {
  check(in.height <= ssim::kSsimMostRows && in.width <= ssim::kSsimMostRows, "image must have at most ", ssim::kSsimMostRows,
        " pixels on a side, got ", in.width, " x ", in.height);
  DeviceImageLoss loss = {};
  loss.image = data(in.image), loss.target = in.target_values, loss.target_bytes = in.target_bytes, loss.mask = in.tissue;
  loss.target_depth = data(in.target_depth);
  loss.ssim_weight = float(weights.ssim), loss.depth_weight = float(weights.depth);
  loss.height = int32_t(in.height), loss.width = int32_t(in.width), loss.pixels = in.pixels;
  loss.channels = int32_t(in.channels), loss.stride = int32_t(in.image.size(2));
  loss.squared = weights.squared;
  loss.loss = mutable_data(out.loss), loss.terms = mutable_data(out.terms), loss.v_image = mutable_data(out.v_image);
  return loss;
}

void run(Call& call, const Images& in, const Weights& weights, const Results& out) {
  DeviceImageLoss loss = device_loss(in, weights, out);
  if (in.depth.has_value()) {
    loss.depth = data(in.depth), loss.v_depth = mutable_data(out.v_depth);
  } else {
    loss.target_depth = nullptr;
  }
  image_loss_on_device(loss, call, call.stream);
}

#else

constexpr int64_t kRows = 16;  // minimum rows per task

// Return the sum of the rows' partial sums, added in row order, independent of the thread that computed each row.
template <typename T>
T total(const std::vector<T>& rows) {
  return std::accumulate(rows.begin(), rows.end(), T(0));
}

double depth_term(const Images& in, double weight, float* gradient) {
  std::vector<double> sums(size_t(in.height));
  std::vector<int64_t> counts(size_t(in.height));
  DepthTask task = {data(in.depth), data(in.target_depth), in.tissue, gradient, 0, sums.data(), counts.data(), in.width};
  torch::stable::parallel_for(0, in.height, kRows,
                              [&](int64_t begin, int64_t end) { kernels().count_depth_rows(task, begin, end); });
  const double valid = double(total(counts));
  task.scale = valid > 0 ? float(weight / valid) : 0;
  torch::stable::parallel_for(0, in.height, kRows, [&](int64_t begin, int64_t end) { kernels().depth_rows(task, begin, end); });
  return valid > 0 ? total(sums) / valid : 0;
}

void run(Call&, const Images& in, const Weights& weights, const Results& out) {
  const double values = double(in.channels * (in.tissue ? kernels().count_tissue(in.tissue, in.pixels) : in.pixels));
  std::vector<double> sums(size_t(in.height));
  const double steepness = weights.squared ? 1 / double(kSteepAsL1) : 1;
  const ColourTask colours = {data(in.image),
                              in.target_values,
                              in.target_bytes,
                              in.tissue,
                              mutable_data(out.v_image),
                              values > 0 ? float((1 - weights.ssim) * steepness / values) : 0,
                              sums.data(),
                              in.width,
                              int(in.channels),
                              weights.squared};
  torch::stable::parallel_for(0, in.height, kRows,
                              [&](int64_t begin, int64_t end) { kernels().colour_rows(colours, begin, end); });
  const double colour_sum = weights.squared ? total(sums) * steepness / 2 : total(sums);
  const double colour_term = values > 0 ? colour_sum / values : 0;

  double ssim_term = 0;
  if (weights.ssim != 0 && values > 0) {
    std::vector<double> strips(size_t(in.height * ssim::ssim_strips(in.width, int(in.channels))));
    ssim::SsimTask task = {};
    task.image = colours.image, task.target = colours.target, task.target_bytes = colours.target_bytes, task.mask = in.tissue;
    task.scale = float(-weights.ssim / values);
    task.gradient = colours.gradient, task.sums = strips.data();
    task.height = in.height, task.width = in.width, task.channels = int(in.channels);
    ssim::run_ssim(task);
    ssim_term = total(strips) / values;
  }
  const double inverse_depth_term = in.depth.has_value() ? depth_term(in, weights.depth, mutable_data(out.v_depth)) : 0;
  *mutable_data(out.loss) =
      float((1 - weights.ssim) * colour_term + weights.ssim * ssim_term + weights.depth * inverse_depth_term);
  float* const terms = mutable_data(out.terms);
  terms[0] = float(colour_term), terms[1] = float(ssim_term), terms[2] = float(inverse_depth_term);
}

#endif

std::tuple<Tensor, Tensor, Tensor, Tensor> image_loss(Tensor image, Tensor target, OptionalTensor mask, OptionalTensor depth,
                                                      OptionalTensor target_depth, double ssim_weight, double depth_weight,
                                                      bool squared) {
  Call call(image);
  const Images in(call, image, target, mask, depth, depth.has_value() ? target_depth : std::nullopt, 0);
  const Results out = {call.empty({}), call.empty({3}), call.empty({in.height, in.width, in.channels}),
                       depth.has_value() ? call.empty({in.height, in.width}) : call.empty({0})};
  run(call, in, {ssim_weight, depth_weight, squared}, out);
  call.finish("image_loss");
  return {out.loss, out.terms, out.v_image, out.v_depth};
}

#if defined(GSPLAT_CUDA)

// Loss of an image of render_frame: its fourth channel is the weighted sum of z, and the depth is that channel divided
// by alpha.
std::tuple<Tensor, Tensor, Tensor, Tensor> frame_loss(Tensor image, Tensor alphas, Tensor target, OptionalTensor mask,
                                                      OptionalTensor target_depth, double ssim_weight, double depth_weight,
                                                      bool squared) {
  Call call(image);
  const Images in(call, image, target, mask, std::nullopt, target_depth, 1);
  check(in.channels == 3 && in.target_bytes != nullptr, "frame_loss takes an image [H, W, 4] and a target uint8 [H, W, 3]");
  const Tensor opacity = call.floats(alphas, "alphas");
  in.check_plane(opacity, "alphas");
  const Results out = {call.empty({}), call.empty({3}), call.empty({in.height, in.width, 4}), call.empty({in.height, in.width})};
  DeviceImageLoss loss = device_loss(in, {ssim_weight, depth_weight, squared}, out);
  loss.alphas = data(opacity), loss.v_alphas = mutable_data(out.v_depth);
  image_loss_on_device(loss, call, call.stream);
  call.finish("frame_loss");
  return {out.loss, out.terms, out.v_image, out.v_depth};
}

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) { m.impl("frame_loss", GSPLAT_BOX(&frame_loss)); }

#endif

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) { m.impl("image_loss", GSPLAT_BOX(&image_loss)); }

}  // namespace gsplat::image_loss
