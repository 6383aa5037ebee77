// Host code of splat_rays and splat_rays_backward: checks, memory, and the launch on each device.
#include "splat_rays.h"

#include <tuple>

#include "host_call.h"

namespace gsplat::splat_rays {
namespace {

// Checked inputs of either pass. The tensors own the memory that `in` points to.
struct Arguments {
  Tensor means, quats, scales, viewmat, K;
  Inputs in;

  Arguments(const Call& call, const Tensor& means_, const Tensor& quats_, const Tensor& scales_, const Tensor& viewmat_,
            const Tensor& K_)
      : means(call.floats(means_, "means")),
        quats(call.floats(quats_, "quats")),
        scales(call.floats(scales_, "scales")),
        viewmat(call.floats(viewmat_, "viewmat")),
        K(call.floats(K_, "K")) {
    const int64_t count = means.dim() == 2 ? means.size(0) : -1;
    check(count >= 0 && means.numel() == 3 * count && quats.numel() == 4 * count && scales.numel() == 3 * count &&
              viewmat.numel() == 16 && K.numel() == 9,
          "splat_rays takes means [N, 3], quats [N, 4], scales [N, 3], viewmat [4, 4] and K [3, 3]");
    in = {data(means), data(quats), data(scales), data(viewmat), data(K), count};
  }
};

#if defined(GSPLAT_CUDA)

void forward(const Call& call, const Inputs& in, float* rays, float* normals) {
  forward_on_device(in, rays, normals, call.stream);
}
void backward(const Call& call, const Inputs& in, const Gradients& gradients) { backward_on_device(in, gradients, call.stream); }

#else

constexpr int64_t kGrain = 2048;  // minimum rows per task

void forward(const Call&, const Inputs& in, float* rays, float* normals) {
  torch::stable::parallel_for(0, in.count, kGrain,
                              [&](int64_t begin, int64_t end) { kernels().forward(in, rays, normals, begin, end); });
}
void backward(const Call&, const Inputs& in, const Gradients& gradients) {
  torch::stable::parallel_for(0, in.count, kGrain,
                              [&](int64_t begin, int64_t end) { kernels().backward(in, gradients, begin, end); });
}

#endif

std::tuple<Tensor, Tensor> splat_rays(Tensor means, Tensor quats, Tensor scales, Tensor viewmat, Tensor K) {
  const Call call(means);
  const Arguments arguments(call, means, quats, scales, viewmat, K);
  Tensor rays = call.empty({arguments.in.count, 10}), normals = call.empty({arguments.in.count, 3});
  forward(call, arguments.in, mutable_data(rays), mutable_data(normals));
  call.finish("splat_rays");
  return {rays, normals};
}

std::tuple<Tensor, Tensor, Tensor> splat_rays_backward(Tensor means, Tensor quats, Tensor scales, Tensor viewmat, Tensor K,
                                                       Tensor v_rays, Tensor v_normals) {
  const Call call(means);
  const Arguments arguments(call, means, quats, scales, viewmat, K);
  const int64_t count = arguments.in.count;
  const Tensor v_rays_ = call.floats(v_rays, "v_rays"), v_normals_ = call.floats(v_normals, "v_normals");
  check(v_rays_.numel() == 10 * count && v_normals_.numel() == 3 * count,
        "splat_rays_backward: gradients must be [N, 10] and [N, 3]");
  Tensor v_means = call.empty({count, 3}), v_quats = call.empty({count, 4}), v_scales = call.empty({count, 3});
  backward(call, arguments.in,
           {data(v_rays_), data(v_normals_), mutable_data(v_means), mutable_data(v_quats), mutable_data(v_scales)});
  call.finish("splat_rays_backward");
  return {v_means, v_quats, v_scales};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("splat_rays", GSPLAT_BOX(&splat_rays));
  m.impl("splat_rays_backward", GSPLAT_BOX(&splat_rays_backward));
}

}  // namespace gsplat::splat_rays
