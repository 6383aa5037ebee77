#include "cuda_call.h"
#include "ssim_cuda.h"

namespace {

constexpr int64_t kMostRows = 65535 * 32;  // a grid's second dimension

DeviceSsim images(const CudaCall& call, const Tensor& image, const Tensor& target) {
  check(image.dim() == 3 && target.dim() == 3, "image and target must be [H, W, C]");
  for (int d = 0; d < 3; ++d) check(image.size(d) == target.size(d), "image and target must have one shape");
  check(image.size(2) >= 1 && image.size(2) <= 32, "image must have 1 to 32 channels");
  check(image.size(0) <= kMostRows && image.size(1) <= kMostRows, "image must have at most ", kMostRows, " pixels on a side");
  DeviceSsim ssim = {};
  ssim.image = data(image), ssim.target = data(target), ssim.scale = 1;
  ssim.height = int32_t(image.size(0)), ssim.width = int32_t(image.size(1));
  ssim.channels = ssim.stride = int32_t(image.size(2));
  return ssim;
}

Tensor ssim_map(Tensor image, Tensor target) {
  CudaCall call(image);
  const Tensor x = call.floats(image, "image"), y = call.floats(target, "target");
  DeviceSsim ssim = images(call, x, y);
  Tensor map = call.empty({ssim.height, ssim.width, ssim.channels});
  ssim.map = mutable_data(map);
  ssim_on_device(ssim, call, call.stream);
  check_cuda(cudaGetLastError(), "ssim_map");
  return map;
}

Tensor ssim_map_backward(Tensor gradient, Tensor image, Tensor target) {
  CudaCall call(image);
  const Tensor g = call.floats(gradient, "gradient"), x = call.floats(image, "image"), y = call.floats(target, "target");
  DeviceSsim ssim = images(call, x, y);
  check(g.numel() == x.numel(), "the gradient must have the map's shape");
  Tensor result = call.empty({ssim.height, ssim.width, ssim.channels});
  check_cuda(cudaMemsetAsync(mutable_data(result), 0, size_t(result.numel()) * sizeof(float), call.stream), "ssim_map_backward");
  ssim.upstream = data(g), ssim.gradient = mutable_data(result);
  ssim_on_device(ssim, call, call.stream);
  check_cuda(cudaGetLastError(), "ssim_map_backward");
  return result;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("ssim_map", GSPLAT_BOX(&ssim_map));
  m.impl("ssim_map_backward", GSPLAT_BOX(&ssim_map_backward));
}
