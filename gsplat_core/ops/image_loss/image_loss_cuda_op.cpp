#include <optional>
#include <tuple>

#include "cuda_call.h"
#include "image_loss_cuda.h"

namespace {

constexpr int64_t kMostRows = 65535 * 32;  // a grid's second dimension

const uint8_t* bytes(const CudaCall& call, Tensor& kept, const Tensor& t, int64_t count, const char* name) {
  kept = call.take(t, ScalarType::Byte, name);
  check(kept.numel() == count, name, " must have one value per pixel and channel, ", count, ", got ", kept.numel());
  return kept.const_data_ptr<uint8_t>();
}

const float* plane(const CudaCall& call, Tensor& kept, const Tensor& t, int64_t pixels, const char* name) {
  kept = call.floats(t, name);
  check(kept.numel() == pixels, name, " must be [H, W]");
  return data(kept);
}

void set_size(DeviceImageLoss& loss, const Tensor& image, int64_t channels) {
  check(image.dim() == 3, "image must be [H, W, C]");
  check(channels >= 1 && channels <= 32, "image must have 1 to 32 channels");
  check(image.size(0) <= kMostRows && image.size(1) <= kMostRows, "image must have at most ", kMostRows, " pixels on a side");
  loss.image = data(image);
  loss.height = int32_t(image.size(0)), loss.width = int32_t(image.size(1));
  loss.pixels = image.size(0) * image.size(1);
  loss.channels = int32_t(channels), loss.stride = int32_t(image.size(2));
}

std::tuple<Tensor, Tensor, Tensor, Tensor> image_loss(Tensor image, Tensor target, std::optional<Tensor> mask,
                                                      std::optional<Tensor> depth, std::optional<Tensor> target_depth,
                                                      double ssim_weight, double depth_weight) {
  CudaCall call(image);
  const Tensor x = call.floats(image, "image");
  DeviceImageLoss loss = {};
  set_size(loss, x, x.dim() == 3 ? x.size(2) : 0);
  const int64_t pixels = loss.pixels, values = pixels * loss.channels;
  Tensor y, tissue, z, target_z;
  if (target.scalar_type() == ScalarType::Byte) {
    loss.target_bytes = bytes(call, y, target, values, "target");
  } else {
    loss.target = plane(call, y, target, values, "target");
  }
  if (mask) loss.mask = bytes(call, tissue, *mask, pixels, "mask");
  if (depth) {
    check(target_depth.has_value(), "depth needs target_depth");
    loss.depth = plane(call, z, *depth, pixels, "depth");
    loss.target_depth = plane(call, target_z, *target_depth, pixels, "target_depth");
  }
  loss.ssim_weight = float(ssim_weight), loss.depth_weight = float(depth_weight);
  Tensor total = call.empty({}), terms = call.empty({3}), v_image = call.empty({loss.height, loss.width, loss.channels});
  Tensor v_depth = depth ? call.empty({loss.height, loss.width}) : call.empty({0});
  loss.loss = mutable_data(total), loss.terms = mutable_data(terms), loss.v_image = mutable_data(v_image);
  loss.v_depth = depth ? mutable_data(v_depth) : nullptr;
  image_loss_on_device(loss, call, call.stream);
  check_cuda(cudaGetLastError(), "image_loss");
  return {total, terms, v_image, v_depth};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> frame_loss(Tensor image, Tensor alphas, Tensor target, std::optional<Tensor> mask,
                                                      std::optional<Tensor> target_depth, double ssim_weight,
                                                      double depth_weight) {
  CudaCall call(image);
  const Tensor x = call.floats(image, "image");
  check(x.dim() == 3 && x.size(2) == 4, "a frame's image must be [H, W, 4]");
  DeviceImageLoss loss = {};
  set_size(loss, x, 3);
  const int64_t pixels = loss.pixels;
  Tensor opacity, y, tissue, target_z;
  loss.alphas = plane(call, opacity, alphas, pixels, "alphas");
  loss.target_bytes = bytes(call, y, target, pixels * 3, "target");
  if (mask) loss.mask = bytes(call, tissue, *mask, pixels, "mask");
  if (target_depth) loss.target_depth = plane(call, target_z, *target_depth, pixels, "target_depth");
  loss.ssim_weight = float(ssim_weight), loss.depth_weight = float(depth_weight);
  Tensor total = call.empty({}), terms = call.empty({3}), v_image = call.empty({loss.height, loss.width, 4});
  Tensor v_alphas = call.empty({loss.height, loss.width});
  loss.loss = mutable_data(total), loss.terms = mutable_data(terms);
  loss.v_image = mutable_data(v_image), loss.v_alphas = mutable_data(v_alphas);
  image_loss_on_device(loss, call, call.stream);
  check_cuda(cudaGetLastError(), "frame_loss");
  return {total, terms, v_image, v_alphas};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("image_loss", GSPLAT_BOX(&image_loss));
  m.impl("frame_loss", GSPLAT_BOX(&frame_loss));
}
