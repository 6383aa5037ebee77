// Checked Gaussians and cameras of a projection, for the host files of dense and packed projection.
#pragma once

#include "host_call.h"
#include "projection.h"

namespace gsplat::projection {
namespace {

// Checked inputs, which own the memory that `input` points to.
struct Scene {
  Tensor means, viewmats, intrinsics;
  OptionalTensor covars, quats, scales, opacities;
  ProjectionSize size;
  ProjectionInput input;

  Scene(const Call& call, const Tensor& means_, const OptionalTensor& covars_, const OptionalTensor& quats_,
        const OptionalTensor& scales_, const OptionalTensor& opacities_, const Tensor& viewmats_, const Tensor& intrinsics_)
      : means(call.floats(means_, "means")),
        viewmats(call.floats(viewmats_, "viewmats")),
        intrinsics(call.floats(intrinsics_, "Ks")),
        covars(call.floats(covars_, "covars")),
        quats(call.floats(quats_, "quats")),
        scales(call.floats(scales_, "scales")),
        opacities(call.floats(opacities_, "opacities")),
        input{} {
    check(means.dim() == 3 && viewmats.dim() == 4, "projection takes means [B, N, 3] and viewmats [B, C, 4, 4]");
    check(covars.has_value() != (quats.has_value() && scales.has_value()), "projection takes covars, or quats and scales");
    size = {means.size(0), viewmats.size(1), means.size(1)};
    const int64_t rows = size.batches * size.gaussians, views = size.batches * size.cameras;
    const auto fits = [&](const OptionalTensor& t, int64_t columns) { return !t.has_value() || t->numel() == columns * rows; };
    check(means.numel() == 3 * rows && viewmats.numel() == 16 * views && intrinsics.numel() == 9 * views && fits(covars, 6) &&
              fits(quats, 4) && fits(scales, 3) && fits(opacities, 1),
          "projection: the sizes of the inputs do not fit together for ", size.batches, " batches of ", size.gaussians,
          " Gaussians and ", size.cameras, " cameras");
    input.means = data(means), input.covars = data(covars), input.quats = data(quats), input.scales = data(scales);
    input.opacities = data(opacities), input.viewmat = data(viewmats), input.intrinsics = data(intrinsics);
  }
};

template <class T>
T* at(T* p, int64_t offset) {
  return p == nullptr ? nullptr : p + offset;
}

}  // namespace
}  // namespace gsplat::projection
