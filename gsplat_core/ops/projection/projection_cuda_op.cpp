#include <tuple>

#include "cuda_call.h"
#include "projection_cuda.h"
#include "projection_scene.h"

namespace {

auto floats_of(const CudaCall& call) {
  return [&call](const Tensor& t, const char* name) { return call.floats(t, name); };
}

ProjectionSize size_of(const ProjectionScene& scene) { return {scene.batches, scene.cameras, scene.gaussians}; }

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> project_gaussians(Tensor means, OptionalTensor covars, OptionalTensor quats,
                                                                     OptionalTensor scales, OptionalTensor opacities,
                                                                     Tensor viewmats, Tensor intrinsics, int64_t width,
                                                                     int64_t height, double eps2d, double near_plane,
                                                                     double far_plane, double radius_clip, bool compensate,
                                                                     int64_t camera_model) {
  const CudaCall call(means);
  ProjectionScene scene(floats_of(call), means, covars, quats, scales, opacities, viewmats, intrinsics);
  ProjectionInput& s = scene.settings;
  s.width = float(width);
  s.height = float(height);
  s.eps2d = float(eps2d);
  s.near_plane = float(near_plane);
  s.far_plane = float(far_plane);
  s.radius_clip = float(radius_clip);
  s.model = CameraModel(camera_model);
  const int64_t B = scene.batches, C = scene.cameras, N = scene.gaussians;
  Tensor radii = call.empty({B, C, N, 2}, ScalarType::Int), means2d = call.empty({B, C, N, 2}), depths = call.empty({B, C, N}),
         conics = call.empty({B, C, N, 3});
  Tensor compensations = compensate ? call.empty({B, C, N}) : call.empty({0});
  const ProjectionOutput out = {radii.mutable_data_ptr<int32_t>(), mutable_data(means2d), mutable_data(depths),
                                mutable_data(conics), compensate ? mutable_data(compensations) : nullptr};
  project_on_device(scene.view(0, 0), size_of(scene), out, call.stream);
  check_cuda(cudaGetLastError(), "project_gaussians");
  return {means2d, depths, conics, compensations, radii};
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> project_gaussians_backward(
    Tensor means, OptionalTensor covars, OptionalTensor quats, OptionalTensor scales, Tensor viewmats, Tensor intrinsics,
    Tensor radii_in, OptionalTensor v_means2d_in, OptionalTensor v_depths_in, OptionalTensor v_conics_in,
    OptionalTensor v_compensations_in, int64_t width, int64_t height, double eps2d, int64_t camera_model, bool needs_viewmats) {
  CudaCall call(means);
  const auto floats = floats_of(call);
  ProjectionScene scene(floats, means, covars, quats, scales, std::nullopt, viewmats, intrinsics);
  scene.settings.width = float(width);
  scene.settings.height = float(height);
  scene.settings.eps2d = float(eps2d);
  scene.settings.model = CameraModel(camera_model);
  const int64_t B = scene.batches, C = scene.cameras, N = scene.gaussians;
  const Tensor radii = call.ints(radii_in, "radii");
  const OptionalTensor v_means2d = optional_floats(floats, v_means2d_in, "v_means2d"),
                       v_depths = optional_floats(floats, v_depths_in, "v_depths"),
                       v_conics = optional_floats(floats, v_conics_in, "v_conics"),
                       v_compensations = optional_floats(floats, v_compensations_in, "v_compensations");
  const auto fits = [&](const OptionalTensor& t, int64_t columns) { return !t.has_value() || t->numel() == B * C * N * columns; };
  check(
      radii.numel() == B * C * N * 2 && fits(v_means2d, 2) && fits(v_depths, 1) && fits(v_conics, 3) && fits(v_compensations, 1),
      "projection backward: the sizes of the gradients do not fit the inputs");
  const auto pointer = [](const OptionalTensor& t) { return t.has_value() ? data(*t) : nullptr; };
  const auto gradient = [&](bool wanted, int64_t columns) { return wanted ? call.empty({B, N, columns}) : call.empty({0}); };
  const bool from_covars = scene.covars.has_value();
  Tensor v_means = gradient(true, 3), v_covars = gradient(from_covars, 6), v_quats = gradient(!from_covars, 4),
         v_scales = gradient(!from_covars, 3);
  Tensor v_viewmats = needs_viewmats ? call.empty({B, C, 4, 4}) : call.empty({0});
  if (needs_viewmats)
    check_cuda(cudaMemsetAsync(mutable_data(v_viewmats), 0, size_t(v_viewmats.numel()) * sizeof(float), call.stream),
               "project_gaussians_backward");
  const ProjectionSize size = size_of(scene);
  float* sums = needs_viewmats ? call.array<float>(camera_sums(size) * 12) : nullptr;
  const ProjectionOutputGradient from = {radii.const_data_ptr<int32_t>(), pointer(v_means2d), pointer(v_depths),
                                         pointer(v_conics), pointer(v_compensations)};
  const ProjectionInputGradient to = {
      mutable_data(v_means), mutable_data(v_covars), mutable_data(v_quats), mutable_data(v_scales), sums, false};
  project_backward_on_device(scene.view(0, 0), size, from, to, needs_viewmats ? mutable_data(v_viewmats) : nullptr, call.stream);
  check_cuda(cudaGetLastError(), "project_gaussians_backward");
  return {v_means, v_covars, v_quats, v_scales, v_viewmats};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("project_gaussians", GSPLAT_BOX(&project_gaussians));
  m.impl("project_gaussians_backward", GSPLAT_BOX(&project_gaussians_backward));
}
