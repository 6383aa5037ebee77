// The inputs of projection's ops, on the processor and on CUDA: sizes checked, and pointers for the kernels.
#pragma once

#include <optional>

#include "projection.h"
#include "tensor_checks.h"

using OptionalTensor = std::optional<Tensor>;

template <class Take>
OptionalTensor optional_floats(const Take& floats, const OptionalTensor& t, const char* name) {
  if (!t.has_value()) return std::nullopt;
  return floats(*t, name);
}

// The inputs, checked and made contiguous by `floats(tensor, name)`, and pointers to one camera's share of them.
struct ProjectionScene {
  Tensor means, viewmats, intrinsics;
  OptionalTensor covars, quats, scales, opacities;
  int64_t batches, cameras, gaussians;
  ProjectionInput settings;

  template <class Take>
  ProjectionScene(const Take& floats, const Tensor& means_in, const OptionalTensor& covars_in, const OptionalTensor& quats_in,
                  const OptionalTensor& scales_in, const OptionalTensor& opacities_in, const Tensor& viewmats_in,
                  const Tensor& intrinsics_in)
      : means(floats(means_in, "means")),
        viewmats(floats(viewmats_in, "viewmats")),
        intrinsics(floats(intrinsics_in, "Ks")),
        covars(optional_floats(floats, covars_in, "covars")),
        quats(optional_floats(floats, quats_in, "quats")),
        scales(optional_floats(floats, scales_in, "scales")),
        opacities(optional_floats(floats, opacities_in, "opacities")),
        settings{} {
    check(means.dim() == 3 && viewmats.dim() == 4, "projection takes means [B, N, 3] and viewmats [B, C, 4, 4]");
    check(covars.has_value() != (quats.has_value() && scales.has_value()), "projection takes covars, or quats and scales");
    batches = means.size(0);
    gaussians = means.size(1);
    cameras = viewmats.size(1);
    const int64_t rows = batches * gaussians, views = batches * cameras;
    check(means.numel() == 3 * rows && viewmats.numel() == 16 * views && intrinsics.numel() == 9 * views &&
              (!covars.has_value() || covars->numel() == 6 * rows) && (!quats.has_value() || quats->numel() == 4 * rows) &&
              (!scales.has_value() || scales->numel() == 3 * rows) && (!opacities.has_value() || opacities->numel() == rows),
          "projection: the sizes of the inputs do not fit together");
  }

  ProjectionInput view(int64_t batch, int64_t camera) const {
    const auto at = [&](const OptionalTensor& t, int64_t columns) {
      return t.has_value() ? data(*t) + batch * gaussians * columns : nullptr;
    };
    const int64_t image = batch * cameras + camera;
    ProjectionInput in = settings;
    in.means = data(means) + batch * gaussians * 3;
    in.covars = at(covars, 6);
    in.quats = at(quats, 4);
    in.scales = at(scales, 3);
    in.opacities = at(opacities, 1);
    in.viewmat = data(viewmats) + image * 16;
    in.intrinsics = data(intrinsics) + image * 9;
    return in;
  }
};
