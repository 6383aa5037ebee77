#include <tuple>

#include "projection.h"
#include "projection_scene.h"
#include "tensor_checks.h"

// Fixed, so that sums over blocks come out the same on any number of threads; a multiple of every vector width.
constexpr int64_t kBlock = 1024;

static constexpr auto on_cpu = [](const Tensor& t, const char* name) { return floats(t, name); };
static OptionalTensor floats(const OptionalTensor& t, const char* name) { return optional_floats(on_cpu, t, name); }
static int64_t blocks_of(const ProjectionScene& scene) { return (scene.gaussians + kBlock - 1) / kBlock; }

static std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> project_gaussians(
    Tensor means, OptionalTensor covars, OptionalTensor quats, OptionalTensor scales, OptionalTensor opacities, Tensor viewmats,
    Tensor intrinsics, int64_t width, int64_t height, double eps2d, double near_plane, double far_plane, double radius_clip,
    bool compensate, int64_t camera_model) {
  ProjectionScene scene(on_cpu, means, covars, quats, scales, opacities, viewmats, intrinsics);
  ProjectionInput& s = scene.settings;
  s.width = float(width);
  s.height = float(height);
  s.eps2d = float(eps2d);
  s.near_plane = float(near_plane);
  s.far_plane = float(far_plane);
  s.radius_clip = float(radius_clip);
  s.model = CameraModel(camera_model);
  const int64_t B = scene.batches, C = scene.cameras, N = scene.gaussians, blocks = blocks_of(scene);
  Tensor radii = empty_ints({B, C, N, 2}), means2d = empty_floats({B, C, N, 2}), depths = empty_floats({B, C, N}),
         conics = empty_floats({B, C, N, 3});
  Tensor compensations = compensate ? empty_floats({B, C, N}) : empty_floats({0});
  const ProjectionOutput out = {radii.mutable_data_ptr<int32_t>(), mutable_data(means2d), mutable_data(depths),
                                mutable_data(conics), compensate ? mutable_data(compensations) : nullptr};
  torch::stable::parallel_for(0, B * C * blocks, 1, [&](int64_t from, int64_t to) {
    for (int64_t task = from; task < to; ++task) {
      const int64_t image = task / blocks, begin = task % blocks * kBlock, end = begin + kBlock < N ? begin + kBlock : N;
      const int64_t row = image * N;
      const ProjectionOutput o = {out.radii + 2 * row, out.means2d + 2 * row, out.depths + row, out.conics + 3 * row,
                                  out.compensations == nullptr ? nullptr : out.compensations + row};
      projection_kernels().forward(scene.view(image / C, image % C), o, begin, end);
    }
  });
  return {means2d, depths, conics, compensations, radii};
}

static std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> project_gaussians_backward(
    Tensor means, OptionalTensor covars, OptionalTensor quats, OptionalTensor scales, Tensor viewmats, Tensor intrinsics,
    Tensor radii_in, OptionalTensor v_means2d_in, OptionalTensor v_depths_in, OptionalTensor v_conics_in,
    OptionalTensor v_compensations_in, int64_t width, int64_t height, double eps2d, int64_t camera_model, bool needs_viewmats) {
  ProjectionScene scene(on_cpu, means, covars, quats, scales, std::nullopt, viewmats, intrinsics);
  scene.settings.width = float(width);
  scene.settings.height = float(height);
  scene.settings.eps2d = float(eps2d);
  scene.settings.model = CameraModel(camera_model);
  const int64_t B = scene.batches, C = scene.cameras, N = scene.gaussians, blocks = blocks_of(scene);
  const Tensor radii = ints(radii_in, "radii");
  const OptionalTensor v_means2d = floats(v_means2d_in, "v_means2d"), v_depths = floats(v_depths_in, "v_depths"),
                       v_conics = floats(v_conics_in, "v_conics"),
                       v_compensations = floats(v_compensations_in, "v_compensations");
  const auto fits = [&](const OptionalTensor& t, int64_t columns) { return !t.has_value() || t->numel() == B * C * N * columns; };
  check(
      radii.numel() == B * C * N * 2 && fits(v_means2d, 2) && fits(v_depths, 1) && fits(v_conics, 3) && fits(v_compensations, 1),
      "projection backward: the sizes of the gradients do not fit the inputs");
  const bool from_covars = scene.covars.has_value();
  // With no camera nothing is written below, so the gradients start at zero.
  const auto gradient = [&](bool wanted, int64_t columns) {
    if (!wanted) return empty_floats({0});
    return C == 0 ? zero_floats({B, N, columns}) : empty_floats({B, N, columns});
  };
  Tensor v_means = gradient(true, 3), v_covars = gradient(from_covars, 6), v_quats = gradient(!from_covars, 4),
         v_scales = gradient(!from_covars, 3);
  Tensor partial = zero_floats({needs_viewmats ? B * C * blocks * 12 : 0});
  Tensor v_viewmats = needs_viewmats ? zero_floats({B, C, 4, 4}) : empty_floats({0});
  const ProjectionInputGradient to_all = {mutable_data(v_means),  mutable_data(v_covars), mutable_data(v_quats),
                                          mutable_data(v_scales), mutable_data(partial),  false};
  torch::stable::parallel_for(0, B * blocks, 1, [&](int64_t from, int64_t to) {
    for (int64_t task = from; task < to; ++task) {
      const int64_t batch = task / blocks, block = task % blocks;
      const int64_t begin = block * kBlock, end = begin + kBlock < N ? begin + kBlock : N, row = batch * N;
      for (int64_t camera = 0; camera < C; ++camera) {
        const int64_t image = batch * C + camera, at = image * N;
        const auto share = [&](const OptionalTensor& t, int64_t columns) {
          return t.has_value() ? data(*t) + at * columns : nullptr;
        };
        const ProjectionOutputGradient v = {radii.const_data_ptr<int32_t>() + 2 * at, share(v_means2d, 2), share(v_depths, 1),
                                            share(v_conics, 3), share(v_compensations, 1)};
        const ProjectionInputGradient g = {to_all.means + 3 * row,
                                           from_covars ? to_all.covars + 6 * row : nullptr,
                                           from_covars ? nullptr : to_all.quats + 4 * row,
                                           from_covars ? nullptr : to_all.scales + 3 * row,
                                           needs_viewmats ? to_all.viewmat + (image * blocks + block) * 12 : nullptr,
                                           camera > 0};
        projection_kernels().backward(scene.view(batch, camera), v, g, begin, end);
      }
    }
  });
  if (needs_viewmats) {
    float* v = mutable_data(v_viewmats);
    for (int64_t image = 0; image < B * C; ++image)
      for (int i = 0; i < 12; ++i) {
        double total = 0;
        for (int64_t block = 0; block < blocks; ++block) total += data(partial)[(image * blocks + block) * 12 + i];
        v[image * 16 + (i < 9 ? i / 3 * 4 + i % 3 : (i - 9) * 4 + 3)] = float(total);
      }
  }
  return {v_means, v_covars, v_quats, v_scales, v_viewmats};
}

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CPU, m) {
  m.impl("project_gaussians", GSPLAT_BOX(&project_gaussians));
  m.impl("project_gaussians_backward", GSPLAT_BOX(&project_gaussians_backward));
}
