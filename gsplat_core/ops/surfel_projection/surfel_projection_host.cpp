// Host code of project_surfels and project_surfels_backward: checks, memory, and the launch on each device.
#include "surfel_projection.h"

#include <tuple>

#include "host_call.h"
#include "threads.h"

namespace gsplat::surfel_projection {
namespace {

// Checked inputs, which own the memory that `in` points to.
struct Scene {
  Tensor means, quats, scales, viewmats, intrinsics;
  Size size;
  Inputs in;

  Scene(const Call& call, const Tensor& means_, const Tensor& quats_, const Tensor& scales_, const Tensor& viewmats_,
        const Tensor& intrinsics_)
      : means(call.floats(means_, "means")),
        quats(call.floats(quats_, "quats")),
        scales(call.floats(scales_, "scales")),
        viewmats(call.floats(viewmats_, "viewmats")),
        intrinsics(call.floats(intrinsics_, "Ks")),
        in{} {
    check(means.dim() == 3 && viewmats.dim() == 4, "surfel projection takes means [B, N, 3] and viewmats [B, C, 4, 4]");
    size = {means.size(0), viewmats.size(1), means.size(1)};
    const int64_t rows = size.batches * size.surfels, views = size.batches * size.cameras;
    check(means.numel() == 3 * rows && quats.numel() == 4 * rows && scales.numel() == 3 * rows &&
              viewmats.numel() == 16 * views && intrinsics.numel() == 9 * views,
          "surfel projection: the sizes of the inputs do not fit together for ", size.batches, " batches of ", size.surfels,
          " surfels and ", size.cameras, " cameras");
    in.means = data(means), in.quats = data(quats), in.scales = data(scales);
    in.viewmat = data(viewmats), in.intrinsics = data(intrinsics);
  }
};

#if defined(GSPLAT_CUDA)

void forward(const Call& call, const Scene& scene, const Outputs& out) {
  project_on_device(scene.in, scene.size, out, call.stream);
}

void backward(Call& call, const Scene& scene, const OutputGradients& from, InputGradients to, float* v_viewmats) {
  if (v_viewmats != nullptr) to.viewmat = call.array<float>(camera_sums(scene.size) * kMatrixSums);
  project_backward_on_device(scene.in, scene.size, from, to, v_viewmats, call.stream);
}

#else

constexpr int64_t kBlock = 1024;  // surfels per task; a multiple of every vector width

template <class T>
T* at(T* p, int64_t offset) {
  return p == nullptr ? nullptr : p + offset;
}

void forward(const Call&, const Scene& scene, const Outputs& out) {
  const auto [batches, cameras, surfels] = scene.size;
  for_blocks(batches * cameras, surfels, kBlock, [&](int64_t image, int64_t begin, int64_t end) {
    const int64_t row = image * scene.size.surfels, C = scene.size.cameras;
    const Outputs o = {out.radii + 2 * row, out.means2d + 2 * row, out.depths + row, out.ray_transforms + 9 * row,
                       out.normals + 3 * row};
    kernels().forward(of_camera(scene.in, scene.size, image / C, image % C), o, begin, end);
  });
}

void backward(Call& call, const Scene& scene, const OutputGradients& from, const InputGradients& to, float* v_viewmats) {
  const int64_t C = scene.size.cameras, N = scene.size.surfels, blocks = (N + kBlock - 1) / kBlock;
  const int64_t images = scene.size.batches * C;
  float* const sums = v_viewmats == nullptr ? nullptr : call.array<float>(images * blocks * kMatrixSums);
  for_blocks(scene.size.batches, N, kBlock, [&](int64_t batch, int64_t begin, int64_t end) {
    const int64_t row = batch * N;
    for (int64_t camera = 0; camera < C; ++camera) {
      const int64_t image = batch * C + camera, seen = image * N;
      const OutputGradients v = {from.radii + 2 * seen, at(from.means2d, 2 * seen), at(from.depths, seen),
                                 at(from.ray_transforms, 9 * seen), at(from.normals, 3 * seen)};
      const InputGradients g = {to.means + 3 * row, to.quats + 4 * row, to.scales + 3 * row,
                                at(sums, (image * blocks + begin / kBlock) * kMatrixSums), camera > 0};
      kernels().backward(of_camera(scene.in, scene.size, batch, camera), v, g, begin, end);
    }
  });
  if (v_viewmats == nullptr) return;
  for (int64_t image = 0; image < images; ++image)
    for (int i = 0; i < kMatrixSums; ++i) {
      double total = 0;
      for (int64_t block = 0; block < blocks; ++block) total += sums[(image * blocks + block) * kMatrixSums + i];
      v_viewmats[image * 16 + (i < 9 ? i / 3 * 4 + i % 3 : (i - 9) * 4 + 3)] = float(total);
    }
}

#endif

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> project_surfels(Tensor means, Tensor quats, Tensor scales, Tensor viewmats,
                                                                   Tensor intrinsics, int64_t width, int64_t height,
                                                                   double near_plane, double far_plane, double radius_clip) {
  const Call call(means);
  Scene scene(call, means, quats, scales, viewmats, intrinsics);
  Inputs& in = scene.in;
  in.width = float(width), in.height = float(height);
  in.near_plane = float(near_plane), in.far_plane = float(far_plane), in.radius_clip = float(radius_clip);
  const auto [B, C, N] = scene.size;
  Tensor radii = call.empty({B, C, N, 2}, ScalarType::Int), means2d = call.empty({B, C, N, 2}), depths = call.empty({B, C, N}),
         transforms = call.empty({B, C, N, 3, 3}), normals = call.empty({B, C, N, 3});
  forward(call, scene,
          {radii.mutable_data_ptr<int32_t>(), mutable_data(means2d), mutable_data(depths), mutable_data(transforms),
           mutable_data(normals)});
  call.finish("project_surfels");
  return {means2d, depths, transforms, normals, radii};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> project_surfels_backward(Tensor means, Tensor quats, Tensor scales, Tensor viewmats,
                                                                    Tensor intrinsics, Tensor radii_, OptionalTensor v_means2d_,
                                                                    OptionalTensor v_depths_, OptionalTensor v_transforms_,
                                                                    OptionalTensor v_normals_, bool needs_viewmats) {
  Call call(means);
  const Scene scene(call, means, quats, scales, viewmats, intrinsics);
  const auto [B, C, N] = scene.size;
  const int64_t rows = B * C * N;
  const Tensor radii = call.ints(radii_, "radii");
  const OptionalTensor v_means2d = call.floats(v_means2d_, "v_means2d"), v_depths = call.floats(v_depths_, "v_depths"),
                       v_transforms = call.floats(v_transforms_, "v_ray_transforms"),
                       v_normals = call.floats(v_normals_, "v_normals");
  const auto fits = [&](const OptionalTensor& t, int64_t columns) { return !t.has_value() || t->numel() == rows * columns; };
  check(radii.numel() == 2 * rows && fits(v_means2d, 2) && fits(v_depths, 1) && fits(v_transforms, 9) && fits(v_normals, 3),
        "surfel projection backward: the sizes of the gradients do not fit the ", rows, " projected surfels of the inputs");
  // Without cameras no CPU kernel writes the outputs, so they must be zeroed.
  const bool unwritten = C == 0;
  const auto gradient = [&, B = B, N = N](int64_t columns) {
    return unwritten ? call.zeros({B, N, columns}) : call.empty({B, N, columns});
  };
  Tensor v_means = gradient(3), v_quats = gradient(4), v_scales = gradient(3),
         v_viewmats = needs_viewmats ? call.zeros({B, C, 4, 4}) : call.empty({0});
  backward(call, scene, {radii.const_data_ptr<int32_t>(), data(v_means2d), data(v_depths), data(v_transforms), data(v_normals)},
           {mutable_data(v_means), mutable_data(v_quats), mutable_data(v_scales), nullptr, false},
           needs_viewmats ? mutable_data(v_viewmats) : nullptr);
  call.finish("project_surfels_backward");
  return {v_means, v_quats, v_scales, v_viewmats};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("project_surfels", GSPLAT_BOX(&project_surfels));
  m.impl("project_surfels_backward", GSPLAT_BOX(&project_surfels_backward));
}

}  // namespace gsplat::surfel_projection
