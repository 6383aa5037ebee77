#include <tuple>

#include "host_call.h"
#include "projection_scene.h"
#include "threads.h"

namespace gsplat::projection {
namespace {

#if defined(GSPLAT_CUDA)

void forward(const Call& call, const Scene& scene, const ProjectionOutput& out) {
  project_on_device(scene.input, scene.size, out, call.stream);
}

void backward(Call& call, const Scene& scene, const ProjectionOutputGradient& from, ProjectionInputGradient to,
              float* v_viewmats) {
  if (v_viewmats != nullptr) to.viewmat = call.array<float>(camera_sums(scene.size) * 12);
  project_backward_on_device(scene.input, scene.size, from, to, v_viewmats, call.stream);
}

#else

constexpr int64_t kBlock = 1024;  // Gaussians per task; a multiple of every vector width

void forward(const Call&, const Scene& scene, const ProjectionOutput& out) {
  const auto [batches, cameras, gaussians] = scene.size;
  for_blocks(batches * cameras, gaussians, kBlock, [&](int64_t image, int64_t begin, int64_t end) {
    const int64_t row = image * scene.size.gaussians;
    const ProjectionOutput o = {out.radii + 2 * row, out.means2d + 2 * row, out.depths + row, out.conics + 3 * row,
                                at(out.compensations, row)};
    kernels().forward(of_camera(scene.input, scene.size, image / scene.size.cameras, image % scene.size.cameras), o, begin, end);
  });
}

void backward(Call& call, const Scene& scene, const ProjectionOutputGradient& from, const ProjectionInputGradient& to,
              float* v_viewmats) {
  const int64_t C = scene.size.cameras, N = scene.size.gaussians, blocks = (N + kBlock - 1) / kBlock;
  const int64_t images = scene.size.batches * C;
  float* const sums = v_viewmats == nullptr ? nullptr : call.array<float>(images * blocks * 12);
  for_blocks(scene.size.batches, N, kBlock, [&](int64_t batch, int64_t begin, int64_t end) {
    const int64_t row = batch * N;
    for (int64_t camera = 0; camera < C; ++camera) {
      const int64_t image = batch * C + camera, seen = image * N;
      const ProjectionOutputGradient v = {from.radii + 2 * seen, at(from.means2d, 2 * seen), at(from.depths, seen),
                                          at(from.conics, 3 * seen), at(from.compensations, seen)};
      const ProjectionInputGradient g = {to.means + 3 * row,
                                         at(to.covars, 6 * row),
                                         at(to.quats, 4 * row),
                                         at(to.scales, 3 * row),
                                         at(sums, (image * blocks + begin / kBlock) * 12),
                                         camera > 0};
      kernels().backward(of_camera(scene.input, scene.size, batch, camera), v, g, begin, end);
    }
  });
  if (v_viewmats == nullptr) return;
  for (int64_t image = 0; image < images; ++image)
    for (int i = 0; i < 12; ++i) {
      double total = 0;
      for (int64_t block = 0; block < blocks; ++block) total += sums[(image * blocks + block) * 12 + i];
      v_viewmats[image * 16 + (i < 9 ? i / 3 * 4 + i % 3 : (i - 9) * 4 + 3)] = float(total);
    }
}

#endif

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> project_gaussians(Tensor means, OptionalTensor covars, OptionalTensor quats,
                                                                     OptionalTensor scales, OptionalTensor opacities,
                                                                     Tensor viewmats, Tensor intrinsics, int64_t width,
                                                                     int64_t height, double eps2d, double near_plane,
                                                                     double far_plane, double radius_clip, bool compensate,
                                                                     int64_t camera_model, double compensation_floor) {
  const Call call(means);
  Scene scene(call, means, covars, quats, scales, opacities, viewmats, intrinsics);
  ProjectionInput& in = scene.input;
  in.width = float(width), in.height = float(height), in.eps2d = float(eps2d);
  in.near_plane = float(near_plane), in.far_plane = float(far_plane), in.radius_clip = float(radius_clip);
  in.model = CameraModel(camera_model), in.compensation_floor = float(compensation_floor);
  const auto [B, C, N] = scene.size;
  Tensor radii = call.empty({B, C, N, 2}, ScalarType::Int), means2d = call.empty({B, C, N, 2}), depths = call.empty({B, C, N}),
         conics = call.empty({B, C, N, 3}), compensations = compensate ? call.empty({B, C, N}) : call.empty({0});
  forward(call, scene,
          {radii.mutable_data_ptr<int32_t>(), mutable_data(means2d), mutable_data(depths), mutable_data(conics),
           compensate ? mutable_data(compensations) : nullptr});
  call.finish("project_gaussians");
  return {means2d, depths, conics, compensations, radii};
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> project_gaussians_backward(
    Tensor means, OptionalTensor covars, OptionalTensor quats, OptionalTensor scales, Tensor viewmats, Tensor intrinsics,
    Tensor radii_, OptionalTensor v_means2d_, OptionalTensor v_depths_, OptionalTensor v_conics_, OptionalTensor v_compensations_,
    int64_t width, int64_t height, double eps2d, int64_t camera_model, bool needs_viewmats, double compensation_floor) {
  Call call(means);
  Scene scene(call, means, covars, quats, scales, std::nullopt, viewmats, intrinsics);
  ProjectionInput& in = scene.input;
  in.width = float(width), in.height = float(height), in.eps2d = float(eps2d), in.model = CameraModel(camera_model);
  in.compensation_floor = float(compensation_floor);
  const auto [B, C, N] = scene.size;
  const int64_t rows = B * C * N;
  const Tensor radii = call.ints(radii_, "radii");
  const OptionalTensor v_means2d = call.floats(v_means2d_, "v_means2d"), v_depths = call.floats(v_depths_, "v_depths"),
                       v_conics = call.floats(v_conics_, "v_conics"),
                       v_compensations = call.floats(v_compensations_, "v_compensations");
  const auto fits = [&](const OptionalTensor& t, int64_t columns) { return !t.has_value() || t->numel() == rows * columns; };
  check(radii.numel() == 2 * rows && fits(v_means2d, 2) && fits(v_depths, 1) && fits(v_conics, 3) && fits(v_compensations, 1),
        "projection backward: the sizes of the gradients do not fit the ", rows, " projected Gaussians of the inputs");
  // Without cameras no CPU kernel writes the outputs, so they must be zeroed.
  const bool unwritten = C == 0, from_covars = scene.covars.has_value();
  const auto gradient = [&, B = B, N = N](bool wanted, int64_t columns) {
    if (!wanted) return call.empty({0});
    return unwritten ? call.zeros({B, N, columns}) : call.empty({B, N, columns});
  };
  Tensor v_means = gradient(true, 3), v_covars = gradient(from_covars, 6), v_quats = gradient(!from_covars, 4),
         v_scales = gradient(!from_covars, 3), v_viewmats = needs_viewmats ? call.zeros({B, C, 4, 4}) : call.empty({0});
  const ProjectionOutputGradient from = {radii.const_data_ptr<int32_t>(), data(v_means2d), data(v_depths), data(v_conics),
                                         data(v_compensations)};
  const ProjectionInputGradient to = {mutable_data(v_means),
                                      from_covars ? mutable_data(v_covars) : nullptr,
                                      from_covars ? nullptr : mutable_data(v_quats),
                                      from_covars ? nullptr : mutable_data(v_scales),
                                      nullptr,
                                      false};
  backward(call, scene, from, to, needs_viewmats ? mutable_data(v_viewmats) : nullptr);
  call.finish("project_gaussians_backward");
  return {v_means, v_covars, v_quats, v_scales, v_viewmats};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("project_gaussians", GSPLAT_BOX(&project_gaussians));
  m.impl("project_gaussians_backward", GSPLAT_BOX(&project_gaussians_backward));
}

}  // namespace gsplat::projection
