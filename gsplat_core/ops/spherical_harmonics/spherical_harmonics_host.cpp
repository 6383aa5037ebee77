#include <tuple>

#include "host_call.h"
#include "spherical_harmonics.h"
#include "threads.h"

namespace gsplat::spherical_harmonics {
namespace {

// R rows of directions over M sets of coefficients, checked. The tensors own the memory that `input` points to.
struct Scene {
  Tensor dirs, coeffs;
  OptionalTensor mask;
  int64_t rows, sets, bases;
  SphericalHarmonicsInput input;

  Scene(const Call& call, int64_t degree, const Tensor& dirs_, const Tensor& coeffs_, const OptionalTensor& mask_)
      : dirs(call.floats(dirs_, "dirs")),
        coeffs(call.floats(coeffs_, "coeffs")),
        mask(call.take_optional(mask_, ScalarType::Bool, "masks")) {
    check(dirs.dim() == 3 && coeffs.dim() == 3 && coeffs.size(0) == dirs.size(1) && dirs.size(2) == 3 && coeffs.size(2) == 3 &&
              degree >= 0 && degree <= 4 && coeffs.size(1) >= (degree + 1) * (degree + 1),
          "spherical harmonics take dirs [R, M, 3] and coeffs [M, K, 3] with K >= (degree + 1)^2, degree 0 to 4; got degree ",
          degree);
    rows = dirs.size(0), sets = dirs.size(1), bases = coeffs.size(1);
    check(!mask.has_value() || mask->numel() == rows * sets, "masks must be bool [R, M]");
    input = {data(dirs), data(coeffs), mask.has_value() ? mask->const_data_ptr<bool>() : nullptr, int(degree), bases};
  }
};

#if defined(GSPLAT_CUDA)

void forward(const Call& call, const Scene& scene, float* colors) {
  harmonics_forward(scene.input, scene.rows, scene.sets, colors, call.stream);
}

void backward(const Call& call, const Scene& scene, const float* v_colors, float* v_dirs, float* v_coeffs) {
  harmonics_backward(scene.input, scene.rows, scene.sets, v_colors, v_dirs, v_coeffs, call.stream);
}

#else

constexpr int64_t kBlock = 1024;  // directions per task

SphericalHarmonicsInput row_of(const Scene& scene, int64_t row) {
  SphericalHarmonicsInput in = scene.input;
  in.dirs += row * scene.sets * 3;
  if (in.mask != nullptr) in.mask += row * scene.sets;
  return in;
}

void forward(const Call&, const Scene& scene, float* colors) {
  for_blocks(scene.rows, scene.sets, kBlock, [&](int64_t row, int64_t begin, int64_t end) {
    kernels().forward(row_of(scene, row), colors + row * scene.sets * 3, begin, end);
  });
}

// Each task processes all rows of a block of sets in order, so the sum over rows does not depend on the number of
// threads.
void backward(const Call&, const Scene& scene, const float* v_colors, float* v_dirs, float* v_coeffs) {
  for_blocks(1, scene.sets, kBlock, [&](int64_t, int64_t begin, int64_t end) {
    for (int64_t row = 0; row < scene.rows; ++row) {
      const int64_t first = row * scene.sets * 3;
      kernels().backward(row_of(scene, row), v_colors + first, v_dirs == nullptr ? nullptr : v_dirs + first, v_coeffs, row > 0,
                         begin, end);
    }
  });
}

#endif

Tensor spherical_harmonics(int64_t degree, Tensor dirs, Tensor coeffs, OptionalTensor masks) {
  const Call call(dirs);
  const Scene scene(call, degree, dirs, coeffs, masks);
  Tensor colors = call.empty({scene.rows, scene.sets, 3});
  forward(call, scene, mutable_data(colors));
  call.finish("spherical_harmonics");
  return colors;
}

std::tuple<Tensor, Tensor> spherical_harmonics_backward(int64_t degree, Tensor dirs, Tensor coeffs, OptionalTensor masks,
                                                        Tensor v_colors_, bool needs_dirs) {
  const Call call(dirs);
  const Scene scene(call, degree, dirs, coeffs, masks);
  const Tensor v_colors = call.floats(v_colors_, "v_colors");
  check(v_colors.numel() == scene.rows * scene.sets * 3, "v_colors must be [R, M, 3], got ", v_colors.numel(), " values");
  Tensor v_dirs = needs_dirs ? call.empty({scene.rows, scene.sets, 3}) : call.empty({0});
  // Without rows no CPU kernel writes the gradient, so it must be zeroed.
  Tensor v_coeffs = scene.rows == 0 ? call.zeros({scene.sets, scene.bases, 3}) : call.empty({scene.sets, scene.bases, 3});
  backward(call, scene, data(v_colors), needs_dirs ? mutable_data(v_dirs) : nullptr, mutable_data(v_coeffs));
  call.finish("spherical_harmonics_backward");
  return {v_dirs, v_coeffs};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("spherical_harmonics", GSPLAT_BOX(&spherical_harmonics));
  m.impl("spherical_harmonics_backward", GSPLAT_BOX(&spherical_harmonics_backward));
}

}  // namespace gsplat::spherical_harmonics
