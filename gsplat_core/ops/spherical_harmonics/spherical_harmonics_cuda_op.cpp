#include <optional>
#include <tuple>

#include "cuda_call.h"
#include "spherical_harmonics_cuda.h"

namespace {

// R rows of directions over M sets of coefficients.
struct HarmonicsScene {
  CudaCall call;
  Tensor dirs, coeffs;
  std::optional<Tensor> mask;
  int64_t rows, sets, bases;
  SphericalHarmonicsInput input;

  HarmonicsScene(int64_t degree, const Tensor& dirs_in, const Tensor& coeffs_in, const std::optional<Tensor>& mask_in)
      : call(dirs_in), dirs(call.floats(dirs_in, "dirs")), coeffs(call.floats(coeffs_in, "coeffs")) {
    check(dirs.dim() == 3 && coeffs.dim() == 3 && coeffs.size(0) == dirs.size(1) && dirs.size(2) == 3 && coeffs.size(2) == 3 &&
              degree >= 0 && degree <= 4 && coeffs.size(1) >= (degree + 1) * (degree + 1),
          "spherical harmonics take dirs [R, M, 3] and coeffs [M, K, 3] with K >= (degree + 1)^2, degree 0 to 4");
    rows = dirs.size(0);
    sets = dirs.size(1);
    bases = coeffs.size(1);
    if (mask_in.has_value()) {
      mask = call.take(*mask_in, ScalarType::Bool, "masks");
      check(mask->numel() == rows * sets, "masks must be bool [R, M]");
    }
    input = {data(dirs), data(coeffs), mask.has_value() ? mask->const_data_ptr<bool>() : nullptr, int(degree), bases};
  }
};

Tensor spherical_harmonics(int64_t degree, Tensor dirs, Tensor coeffs, std::optional<Tensor> masks) {
  const HarmonicsScene scene(degree, dirs, coeffs, masks);
  Tensor colors = scene.call.empty({scene.rows, scene.sets, 3});
  harmonics_forward(scene.input, scene.rows, scene.sets, mutable_data(colors), scene.call.stream);
  check_cuda(cudaGetLastError(), "spherical_harmonics");
  return colors;
}

std::tuple<Tensor, Tensor> spherical_harmonics_backward(int64_t degree, Tensor dirs, Tensor coeffs, std::optional<Tensor> masks,
                                                        Tensor v_colors_in, bool needs_dirs) {
  const HarmonicsScene scene(degree, dirs, coeffs, masks);
  const Tensor v_colors = scene.call.floats(v_colors_in, "v_colors");
  check(v_colors.numel() == scene.rows * scene.sets * 3, "v_colors must be [R, M, 3]");
  Tensor v_dirs = needs_dirs ? scene.call.empty({scene.rows, scene.sets, 3}) : scene.call.empty({0});
  Tensor v_coeffs = scene.call.empty({scene.sets, scene.bases, 3});
  harmonics_backward(scene.input, scene.rows, scene.sets, data(v_colors), needs_dirs ? mutable_data(v_dirs) : nullptr,
                     mutable_data(v_coeffs), scene.call.stream);
  check_cuda(cudaGetLastError(), "spherical_harmonics_backward");
  return {v_dirs, v_coeffs};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("spherical_harmonics", GSPLAT_BOX(&spherical_harmonics));
  m.impl("spherical_harmonics_backward", GSPLAT_BOX(&spherical_harmonics_backward));
}
