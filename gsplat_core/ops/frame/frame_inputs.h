// Checked inputs of render_frame and its backward pass, converted to kernel arguments.
#pragma once

#include <optional>
#include <vector>

#include "cuda_call.h"
#include "frame.h"

namespace gsplat::frame {

constexpr const char* kGaussianTensors[] = {"means", "quats", "log_scales", "logit_opacities", "sh"};

struct ViewArguments {
  int64_t width, height;
  double eps2d, near_plane, far_plane;
  int64_t camera_model;
};

struct Inputs {
  CudaCall call;
  std::vector<Tensor> gaussians;  // means, quats, log_scales, logit_opacities, sh
  Tensor viewmat, intrinsics;
  OptionalTensor deltas, background;
  Scene scene;

  Inputs(const std::vector<Tensor>& gaussians_in, const OptionalTensor& deltas_in, const Tensor& viewmat_in,
         const Tensor& intrinsics_in, const OptionalTensor& background_in, const ViewArguments& view, bool takes_half_sh = false)
      : call(first_of(gaussians_in)), viewmat(call.floats(viewmat_in, "viewmat")), intrinsics(call.floats(intrinsics_in, "K")) {
    for (size_t i = 0; i < gaussians_in.size(); ++i) {
      const Tensor& t = gaussians_in[i];
      const bool half = i + 1 == gaussians_in.size() && takes_half_sh && t.scalar_type() == ScalarType::Half;
      gaussians.push_back(call.take(t, half ? ScalarType::Half : ScalarType::Float, kGaussianTensors[i]));
    }
    if (deltas_in) deltas = call.floats(*deltas_in, "deltas");
    if (background_in) background = call.floats(*background_in, "background");
    check_sizes(view);
    fill_scene(view);
  }

 private:
  static const Tensor& first_of(const std::vector<Tensor>& gaussians) {
    check(gaussians.size() == 5, "render_frame: gaussians must be means, quats, log_scales, logit_opacities and sh; got ",
          gaussians.size(), " tensors");
    return gaussians[0];
  }

  int64_t bases() const { return gaussians[4].dim() == 3 ? gaussians[4].size(1) : 0; }
  int64_t degree() const {
    switch (bases()) {
      case 1: return 0;
      case 4: return 1;
      case 9: return 2;
      case 16: return 3;
      case 25: return 4;
      default: return -1;
    }
  }

  void check_sizes(const ViewArguments& view) const {
    constexpr int64_t kMaxPixels = int64_t(kMaxTilesAcross) * kTile, kMaxGaussians = (int64_t(1) << 31) - 2;
    const int64_t count = gaussians[0].size(0);
    check(degree() >= 0, "render_frame: sh must be [N, B, 3] with B one of 1, 4, 9, 16, 25; got B = ", bases());
    const int64_t columns[] = {3, 4, 3, 1, 3 * bases()};
    for (int i = 0; i < 5; ++i)
      check(gaussians[i].numel() == columns[i] * count, "render_frame: ", kGaussianTensors[i], " must have ", columns[i],
            " values for each of ", count, " Gaussians, got ", gaussians[i].numel());
    check(viewmat.numel() == 16 && intrinsics.numel() == 9, "render_frame: viewmat must be [4, 4] and K [3, 3], got ",
          viewmat.numel(), " and ", intrinsics.numel(), " values");
    check(count <= kMaxGaussians, "render_frame takes at most 2^31 - 2 Gaussians, got ", count);
    check(view.width > 0 && view.height > 0 && view.width <= kMaxPixels && view.height <= kMaxPixels,
          "render_frame: the image must have 1 to ", kMaxPixels, " pixels on a side, got ", view.width, " x ", view.height);
    check(view.camera_model >= 0 && view.camera_model <= 2, "render_frame: no camera model ", view.camera_model);
    check(!deltas || deltas->numel() == kRawColumns * count, "render_frame: deltas must be [", count, ", ", kRawColumns, "]");
    check(!background || background->numel() == 3, "render_frame: background must be [3]");
  }

  void fill_scene(const ViewArguments& view) {
    const auto aligned = [](const Tensor& t) { return reinterpret_cast<uintptr_t>(t.data_ptr()) % 16 == 0; };
    const Tensor& sh = gaussians[4];
    scene = {.means = data(gaussians[0]),
             .quats = data(gaussians[1]),
             .log_scales = data(gaussians[2]),
             .logit_opacities = data(gaussians[3]),
             .sh = static_cast<const float*>(sh.data_ptr()),
             .deltas = deltas ? data(*deltas) : nullptr,
             .viewmat = data(viewmat),
             .intrinsics = data(intrinsics),
             .background = background ? data(*background) : nullptr,
             .count = gaussians[0].size(0),
             .bases = int32_t(bases()),
             .sh_degree = int32_t(degree()),
             .width = int32_t(view.width),
             .height = int32_t(view.height),
             .tile_width = int32_t((view.width + kTile - 1) / kTile),
             .tile_height = int32_t((view.height + kTile - 1) / kTile),
             .eps2d = float(view.eps2d),
             .near_plane = float(view.near_plane),
             .far_plane = float(view.far_plane),
             .camera_model = int32_t(view.camera_model),
             .aligned = aligned(gaussians[1]) && aligned(sh) && (!deltas || aligned(*deltas)),
             .half_sh = sh.scalar_type() == ScalarType::Half};
  }
};

}  // namespace gsplat::frame
