// The inputs of the frame path's ops, checked, and what the kernels are told about them.
#pragma once

#include <cmath>
#include <optional>

#include "cuda_call.h"
#include "frame_cuda.h"

struct FrameInputs {
  CudaCall call;
  Tensor means, quats, log_scales, logit_opacities, sh, viewmat, intrinsics;
  std::optional<Tensor> deltas, background;
  FrameScene scene;

  FrameInputs(const Tensor& means_in, const Tensor& quats_in, const Tensor& log_scales_in, const Tensor& logit_opacities_in,
              const Tensor& sh_in, const std::optional<Tensor>& deltas_in, const Tensor& viewmat_in, const Tensor& intrinsics_in,
              const std::optional<Tensor>& background_in, int64_t width, int64_t height, double eps2d, double near_plane,
              double far_plane, int64_t camera_model, bool takes_half_sh = false)
      : call(means_in),
        means(call.floats(means_in, "means")),
        quats(call.floats(quats_in, "quats")),
        log_scales(call.floats(log_scales_in, "log_scales")),
        logit_opacities(call.floats(logit_opacities_in, "logit_opacities")),
        sh(takes_half_sh && sh_in.scalar_type() == ScalarType::Half ? call.take(sh_in, ScalarType::Half, "sh")
                                                                    : call.floats(sh_in, "sh")),
        viewmat(call.floats(viewmat_in, "viewmat")),
        intrinsics(call.floats(intrinsics_in, "K")) {
    constexpr int64_t kMostPixels = int64_t(kMostTilesAcross) * kFrameTile, kMostGaussians = (int64_t(1) << 31) - 2;
    const int64_t count = means.size(0), bases = sh.dim() == 3 ? sh.size(1) : 0;
    const int64_t degree = bases == 1 ? 0 : bases == 4 ? 1 : bases == 9 ? 2 : bases == 16 ? 3 : bases == 25 ? 4 : -1;
    check(degree >= 0, "render_frame: sh must be [N, B, 3] with B one of 1, 4, 9, 16, 25; got B = ", bases);
    check(means.numel() == 3 * count && quats.numel() == 4 * count && log_scales.numel() == 3 * count &&
              logit_opacities.numel() == count && sh.numel() == 3 * bases * count && viewmat.numel() == 16 &&
              intrinsics.numel() == 9,
          "render_frame: the sizes of the inputs do not fit together for ", count, " Gaussians and one camera");
    check(count <= kMostGaussians, "render_frame takes at most 2^31 - 2 Gaussians, got ", count);
    check(width > 0 && height > 0 && width <= kMostPixels && height <= kMostPixels, "render_frame: the image must have 1 to ",
          kMostPixels, " pixels on a side, got ", width, " x ", height);
    check(camera_model >= 0 && camera_model <= 2, "render_frame: no camera model ", camera_model);
    if (deltas_in) deltas = call.floats(*deltas_in, "deltas");
    if (background_in) background = call.floats(*background_in, "background");
    check(!deltas || deltas->numel() == kRawColumns * count, "render_frame: deltas must be [N, 16]");
    check(!background || background->numel() == 3, "render_frame: background must be [3]");
    const auto aligned = [](const Tensor& t) { return reinterpret_cast<uintptr_t>(t.data_ptr()) % 16 == 0; };
    scene = {data(means),
             data(quats),
             data(log_scales),
             data(logit_opacities),
             static_cast<const float*>(sh.data_ptr()),
             deltas ? data(*deltas) : nullptr,
             data(viewmat),
             data(intrinsics),
             background ? data(*background) : nullptr,
             count,
             int32_t(bases),
             int32_t(degree),
             int32_t(width),
             int32_t(height),
             int32_t((width + kFrameTile - 1) / kFrameTile),
             int32_t((height + kFrameTile - 1) / kFrameTile),
             float(eps2d),
             float(near_plane),
             float(far_plane),
             int32_t(camera_model),
             aligned(quats) && aligned(sh) && (!deltas || aligned(*deltas)),
             sh.scalar_type() == ScalarType::Half};
  }
};
