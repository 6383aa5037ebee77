// Host code of project_unscented and project_unscented_backward: checks, memory, and the launch on each device.
#include "unscented_projection.h"

#include <tuple>

#include "host_call.h"
#include "threads.h"

namespace gsplat::unscented_projection {
namespace {

// Checked inputs of either pass. The tensors own the memory that `in` points to.
struct Arguments {
  Tensor means, quats, scales, cameras;
  OptionalTensor opacities;
  Inputs in{};

  Arguments(const Call& call, const Tensor& means_, const Tensor& quats_, const Tensor& scales_, const OptionalTensor& opacities_,
            const Tensor& cameras_, int64_t model, int64_t shutter)
      : means(call.floats(means_, "means")),
        quats(call.floats(quats_, "quats")),
        scales(call.floats(scales_, "scales")),
        cameras(call.floats(cameras_, "cameras")),
        opacities(call.floats(opacities_, "opacities")) {
    check(means.dim() == 3 && cameras.dim() == 3, "project_unscented takes means [B, N, 3] and cameras [B, C, 35]");
    in.size = {means.size(0), cameras.size(1), means.size(1)};
    const int64_t rows = in.size.batches * in.size.gaussians;
    check(means.numel() == 3 * rows && quats.numel() == 4 * rows && scales.numel() == 3 * rows &&
              (!opacities.has_value() || opacities->numel() == rows) &&
              cameras.numel() == in.size.batches * in.size.cameras * kCameraColumns,
          "project_unscented: the sizes of the inputs do not fit together for ", in.size.batches, " batches of ",
          in.size.gaussians, " Gaussians and ", in.size.cameras, " cameras");
    check(model >= kPinhole && model <= kFisheye && shutter >= kTopToBottom && shutter <= kGlobal,
          "project_unscented: there is no lens model ", model, " or shutter ", shutter);
    in.means = data(means), in.quats = data(quats), in.scales = data(scales), in.cameras = data(cameras);
    in.opacities = data(opacities);
    in.model = LensModel(model), in.shutter = ShutterKind(shutter);
  }
};

#if defined(GSPLAT_CUDA)

void forward(const Call& call, const Inputs& in, const Outputs& out) { project_on_device(in, out, call.stream); }
void backward(const Call& call, const Inputs& in, const Gradients& gradients) {
  project_backward_on_device(in, gradients, call.stream);
}

#else

constexpr int64_t kBlock = 256;  // Gaussians per task; a multiple of every vector width

void forward(const Call&, const Inputs& in, const Outputs& out) {
  for_blocks(in.size.batches * in.size.cameras, in.size.gaussians, kBlock,
             [&](int64_t image, int64_t begin, int64_t end) { kernels().forward(in, out, image, begin, end); });
}
void backward(const Call&, const Inputs& in, const Gradients& gradients) {
  for_blocks(in.size.batches, in.size.gaussians, kBlock,
             [&](int64_t batch, int64_t begin, int64_t end) { kernels().backward(in, gradients, batch, begin, end); });
}

#endif

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> project_unscented(Tensor means, Tensor quats, Tensor scales,
                                                                     OptionalTensor opacities, Tensor cameras, int64_t model,
                                                                     int64_t shutter, bool distorted, int64_t width,
                                                                     int64_t height, double eps2d, double near_plane,
                                                                     double far_plane, double radius_clip, bool compensate,
                                                                     double compensation_floor, double spread, double weight,
                                                                     double center_weight, double margin, bool all_inside) {
  const Call call(means);
  Arguments arguments(call, means, quats, scales, opacities, cameras, model, shutter);
  Inputs& in = arguments.in;
  in.distorted = distorted, in.width = float(width), in.height = float(height), in.eps2d = float(eps2d);
  in.near_plane = float(near_plane), in.far_plane = float(far_plane), in.radius_clip = float(radius_clip);
  in.compensation_floor = float(compensation_floor), in.spread = float(spread), in.weight = float(weight);
  in.center_weight = float(center_weight), in.margin = float(margin), in.all_inside = all_inside;
  const auto [B, C, N] = in.size;
  Tensor radii = call.empty({B, C, N, 2}, ScalarType::Int), means2d = call.empty({B, C, N, 2}), depths = call.empty({B, C, N}),
         conics = call.empty({B, C, N, 3}), compensations = compensate ? call.empty({B, C, N}) : call.empty({0});
  forward(call, in,
          {radii.mutable_data_ptr<int32_t>(), mutable_data(means2d), mutable_data(depths), mutable_data(conics),
           compensate ? mutable_data(compensations) : nullptr});
  call.finish("project_unscented");
  return {means2d, depths, conics, compensations, radii};
}

std::tuple<Tensor, Tensor, Tensor> project_unscented_backward(Tensor means, Tensor quats, Tensor scales, Tensor cameras,
                                                              Tensor radii_, OptionalTensor v_means2d_, OptionalTensor v_depths_,
                                                              OptionalTensor v_conics_, OptionalTensor v_compensations_,
                                                              int64_t model, int64_t shutter, bool distorted, int64_t width,
                                                              int64_t height, double eps2d, double compensation_floor,
                                                              double spread, double weight, double center_weight) {
  const Call call(means);
  Arguments arguments(call, means, quats, scales, std::nullopt, cameras, model, shutter);
  Inputs& in = arguments.in;
  in.distorted = distorted, in.width = float(width), in.height = float(height), in.eps2d = float(eps2d);
  in.compensation_floor = float(compensation_floor), in.spread = float(spread), in.weight = float(weight);
  in.center_weight = float(center_weight);
  const auto [B, C, N] = in.size;
  const int64_t rows = B * C * N;
  const Tensor radii = call.ints(radii_, "radii");
  const OptionalTensor v_means2d = call.floats(v_means2d_, "v_means2d"), v_depths = call.floats(v_depths_, "v_depths"),
                       v_conics = call.floats(v_conics_, "v_conics"),
                       v_compensations = call.floats(v_compensations_, "v_compensations");
  const auto fits = [&](const OptionalTensor& t, int64_t columns) { return !t.has_value() || t->numel() == rows * columns; };
  check(radii.numel() == 2 * rows && fits(v_means2d, 2) && fits(v_depths, 1) && fits(v_conics, 3) && fits(v_compensations, 1),
        "project_unscented_backward: the sizes of the gradients do not fit the ", rows, " projected Gaussians of the inputs");
  Tensor v_means = call.empty({B, N, 3}), v_quats = call.empty({B, N, 4}), v_scales = call.empty({B, N, 3});
  backward(call, in,
           {radii.const_data_ptr<int32_t>(), data(v_means2d), data(v_depths), data(v_conics), data(v_compensations),
            mutable_data(v_means), mutable_data(v_quats), mutable_data(v_scales)});
  call.finish("project_unscented_backward");
  return {v_means, v_quats, v_scales};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("project_unscented", GSPLAT_BOX(&project_unscented));
  m.impl("project_unscented_backward", GSPLAT_BOX(&project_unscented_backward));
}

}  // namespace gsplat::unscented_projection
