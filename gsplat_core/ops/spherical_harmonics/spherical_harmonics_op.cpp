#include <optional>
#include <tuple>

#include "cpu_call.h"
#include "spherical_harmonics.h"

constexpr int64_t kBlock = 1024;

// R rows of directions over M sets of coefficients.
struct HarmonicsScene {
  Tensor dirs, coeffs;
  std::optional<Tensor> mask;
  int64_t rows, sets, bases;
  int degree;

  HarmonicsScene(int64_t degree_in, const Tensor& dirs_in, const Tensor& coeffs_in, const std::optional<Tensor>& mask_in)
      : dirs(floats(dirs_in, "dirs")), coeffs(floats(coeffs_in, "coeffs")), degree(int(degree_in)) {
    check(dirs.dim() == 3 && coeffs.dim() == 3 && coeffs.size(0) == dirs.size(1) && dirs.size(2) == 3 && coeffs.size(2) == 3 &&
              degree >= 0 && degree <= 4 && coeffs.size(1) >= (degree + 1) * (degree + 1),
          "spherical harmonics take dirs [R, M, 3] and coeffs [M, K, 3] with K >= (degree + 1)^2, degree 0 to 4");
    rows = dirs.size(0);
    sets = dirs.size(1);
    bases = coeffs.size(1);
    if (mask_in.has_value()) {
      check(mask_in->is_cpu() && mask_in->scalar_type() == ScalarType::Bool && mask_in->numel() == rows * sets,
            "masks must be bool [R, M] on the CPU");
      mask = mask_in->is_contiguous() ? *mask_in : torch::stable::contiguous(*mask_in);
    }
  }

  int64_t blocks() const { return (sets + kBlock - 1) / kBlock; }

  SphericalHarmonicsInput row(int64_t r) const {
    return {data(dirs) + r * sets * 3, data(coeffs), mask.has_value() ? mask->const_data_ptr<bool>() + r * sets : nullptr, degree,
            bases};
  }
};

static Tensor spherical_harmonics(int64_t degree, Tensor dirs, Tensor coeffs, std::optional<Tensor> masks) {
  const HarmonicsScene scene(degree, dirs, coeffs, masks);
  Tensor colors = empty_floats({scene.rows, scene.sets, 3});
  float* out = mutable_data(colors);
  const int64_t blocks = scene.blocks(), M = scene.sets;
  torch::stable::parallel_for(0, scene.rows * blocks, 1, [&](int64_t from, int64_t to) {
    for (int64_t task = from; task < to; ++task) {
      const int64_t r = task / blocks, begin = task % blocks * kBlock, end = begin + kBlock < M ? begin + kBlock : M;
      spherical_harmonics_kernels().forward(scene.row(r), out + r * M * 3, begin, end);
    }
  });
  return colors;
}

static std::tuple<Tensor, Tensor> spherical_harmonics_backward(int64_t degree, Tensor dirs, Tensor coeffs,
                                                               std::optional<Tensor> masks, Tensor v_colors_in, bool needs_dirs) {
  const HarmonicsScene scene(degree, dirs, coeffs, masks);
  const Tensor v_colors = floats(v_colors_in, "v_colors");
  const int64_t blocks = scene.blocks(), M = scene.sets, R = scene.rows;
  check(v_colors.numel() == R * M * 3, "v_colors must be [R, M, 3]");
  Tensor v_dirs = needs_dirs ? empty_floats({R, M, 3}) : empty_floats({0});
  Tensor v_coeffs = R == 0 ? zero_floats({M, scene.bases, 3}) : empty_floats({M, scene.bases, 3});
  float *to_dirs = mutable_data(v_dirs), *to_coeffs = mutable_data(v_coeffs);
  const float* v = data(v_colors);
  // Over blocks of sets, each with its rows in order: the sum over rows does not depend on the number of threads.
  torch::stable::parallel_for(0, blocks, 1, [&](int64_t from, int64_t to) {
    for (int64_t block = from; block < to; ++block) {
      const int64_t begin = block * kBlock, end = begin + kBlock < M ? begin + kBlock : M;
      for (int64_t r = 0; r < R; ++r)
        spherical_harmonics_kernels().backward(scene.row(r), v + r * M * 3, needs_dirs ? to_dirs + r * M * 3 : nullptr, to_coeffs,
                                               r > 0, begin, end);
    }
  });
  return {v_dirs, v_coeffs};
}

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CPU, m) {
  m.impl("spherical_harmonics", GSPLAT_BOX(&spherical_harmonics));
  m.impl("spherical_harmonics_backward", GSPLAT_BOX(&spherical_harmonics_backward));
}
