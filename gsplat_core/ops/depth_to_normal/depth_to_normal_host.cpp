// Host code of depth_to_normal: checks, memory, and the pass on each device.
#include "depth_to_normal.h"
#include "host_call.h"

namespace gsplat::depth_to_normal {
namespace {

constexpr int64_t kMostPixels = (int64_t(1) << 31) - 1;

#if defined(GSPLAT_CUDA)

void run(const Maps& maps, float* normals, const CudaCall& call) { normals_on_device(maps, normals, call.stream); }
void run(const Maps& maps, const float* v_normals, float* v_depths, const CudaCall& call) {
  gradients_on_device(maps, v_normals, v_depths, call.stream);
}

#else

constexpr int64_t kRows = 16;  // minimum rows per task

void run(const Maps& maps, float* normals, const CpuCall&) {
  torch::stable::parallel_for(0, maps.images * maps.height, kRows,
                              [&](int64_t begin, int64_t end) { kernels().normals(maps, normals, begin, end); });
}
void run(const Maps& maps, const float* v_normals, float* v_depths, const CpuCall&) {
  torch::stable::parallel_for(0, maps.images * maps.height, kRows,
                              [&](int64_t begin, int64_t end) { kernels().gradients(maps, v_normals, v_depths, begin, end); });
}

#endif

// Depth maps with their cameras, checked and contiguous.
struct Given {
  Given(Call& call, const Tensor& depths, const Tensor& camtoworlds, const Tensor& Ks)
      : depths(call.floats(depths, "depths")), to_world(call.floats(camtoworlds, "camtoworlds")), K(call.floats(Ks, "Ks")) {
    check(this->depths.dim() == 3 && this->depths.numel() <= kMostPixels,
          "depth_to_normal: depths must be [I, H, W] with fewer than 2^31 pixels");
    const int64_t images = this->depths.size(0);
    check(to_world.numel() == 16 * images && K.numel() == 9 * images,
          "depth_to_normal: camtoworlds and Ks must have 16 and 9 values for each of ", images, " images, got ", to_world.numel(),
          " and ", K.numel());
    maps = {data(this->depths), data(to_world), data(K), images, int32_t(this->depths.size(1)), int32_t(this->depths.size(2))};
  }
  Tensor depths, to_world, K;
  Maps maps;
};

Tensor depth_to_normal(Tensor depths, Tensor camtoworlds, Tensor Ks) {
  Call call(depths);
  const Given given(call, depths, camtoworlds, Ks);
  const Maps& maps = given.maps;
  Tensor normals = call.empty({maps.images, maps.height, maps.width, 3});
  if (normals.numel() == 0) return normals;
  run(maps, mutable_data(normals), call);
  call.finish("depth_to_normal");
  return normals;
}

Tensor depth_to_normal_backward(Tensor v_normals, Tensor depths, Tensor camtoworlds, Tensor Ks) {
  Call call(depths);
  const Given given(call, depths, camtoworlds, Ks);
  const Tensor v = call.floats(v_normals, "v_normals");
  check(v.numel() == 3 * given.depths.numel(), "depth_to_normal: v_normals must have ", 3 * given.depths.numel(), " values, got ",
        v.numel());
  Tensor v_depths = call.empty({given.maps.images, given.maps.height, given.maps.width});
  if (v_depths.numel() == 0) return v_depths;
  run(given.maps, data(v), mutable_data(v_depths), call);
  call.finish("depth_to_normal_backward");
  return v_depths;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("depth_to_normal", GSPLAT_BOX(&depth_to_normal));
  m.impl("depth_to_normal_backward", GSPLAT_BOX(&depth_to_normal_backward));
}

}  // namespace gsplat::depth_to_normal
