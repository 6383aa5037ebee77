// Host code of range_histogram and its backward pass: checks, memory, and the launch on each device.
#include "range_histogram.h"

#include <tuple>
#include <vector>

#include "../compositing/alpha_limit.h"
#include "../compositing/tiled_splats.h"
#include "host_call.h"
#if !defined(GSPLAT_CUDA)
#include "../compositing/tile_pass.h"
#endif

namespace gsplat::range_histogram {
namespace {

// Checked inputs of either pass. The tensors own the memory that `in` points to.
struct Arguments {
  compositing::TiledSplats splats;
  Tensor rays;
  OptionalTensor factors;
  Inputs in;

  Arguments(const Call& call, const Tensor& means2d, const Tensor& conics, const Tensor& opacities, const Tensor& rays_,
            const Tensor& offsets, const Tensor& flatten_ids, const OptionalTensor& factors_, double nearest, double bin,
            int64_t bins, int64_t width, int64_t height, double max_alpha)
      : splats(call, "range_histogram", means2d, conics, opacities, offsets, flatten_ids, width, height,
               compositing::limit_of(max_alpha)),
        rays(call.floats(rays_, "rays")),
        factors(call.floats(factors_, "factors")) {
    splats.check_rows("range_histogram", "rays", rays, kRayNumbers);
    check(bins >= 1 && bins <= kMaxBins && bin > 0, "range_histogram: 1 to ", kMaxBins, " bins of positive width, got ", bins,
          " of ", bin);
    check(!factors || factors->numel() == width * height, "range_histogram: factors must be [", height, ", ", width, "]");
    in = {.splats = {.splats = splats.in, .rays = data(rays), .values = nullptr, .channels = 0},
          .factors = data(factors),
          .nearest = float(nearest),
          .bin = float(bin),
          .bins = int32_t(bins)};
  }
};

#if defined(GSPLAT_CUDA)

void forward(Call& call, const Inputs& in, float* out) { histogram_on_device(in, out, call, call.stream); }

void backward(Call& call, const Inputs& in, const float* gradient, const InputGradients& out) {
  histogram_backward_on_device(in, gradient, out, call, call.stream);
}

#else

void forward(Call&, const Inputs& in, float* out) {
  const compositing::Inputs& splats = in.splats.splats;
  compositing::check_lists(splats);
  torch::stable::parallel_for(0, splats.tile_width, 1, [&](int64_t begin, int64_t end) {
    std::vector<double> scratch(size_t(kTileSize) * size_t(in.bins));
    for (int64_t column = begin; column < end; ++column) kernels().columns(in, column, scratch.data(), out);
  });
}

void backward(Call&, const Inputs& in, const float* gradient, const InputGradients& out) {
  const compositing::Inputs& splats = in.splats.splats;
  compositing::check_lists(splats);
  std::vector<float> rows(size_t(splats.instances * kGradients));
  torch::stable::parallel_for(0, splats.tiles(), 4, [&](int64_t begin, int64_t end) {
    for (int64_t tile = begin; tile < end; ++tile) kernels().tile_backward(in, gradient, tile, rows.data());
  });
  std::vector<double> sums(size_t(splats.count * kGradients));
  const int64_t first = splats.tiles() > 0 ? splats.offsets[0] : splats.instances;
  for (int64_t i = first; i < splats.instances; ++i) {
    double* const sum = sums.data() + int64_t(splats.flatten_ids[i]) * kGradients;
    for (int k = 0; k < kGradients; ++k) sum[k] += double(rows[size_t(i * kGradients + k)]);
  }
  for (int64_t i = 0; i < splats.count; ++i) {
    const double* const sum = sums.data() + i * kGradients;
    for (int k = 0; k < 2; ++k) out.means2d[2 * i + k] = float(sum[k]);
    for (int k = 0; k < 3; ++k) out.conics[3 * i + k] = float(sum[2 + k]);
    out.opacities[i] = float(sum[5]);
    for (int k = 0; k < kRayNumbers; ++k) out.rays[kRayNumbers * i + k] = float(sum[6 + k]);
  }
}

#endif

Tensor range_histogram(Tensor means2d, Tensor conics, Tensor opacities, Tensor rays, Tensor offsets, Tensor flatten_ids,
                       OptionalTensor factors, double nearest, double bin, int64_t bins, int64_t width, int64_t height,
                       double max_alpha) {
  Call call(means2d);
  const Arguments given(call, means2d, conics, opacities, rays, offsets, flatten_ids, factors, nearest, bin, bins, width, height,
                        max_alpha);
  Tensor out = call.empty({width, bins});
  forward(call, given.in, mutable_data(out));
  call.finish("range_histogram");
  return out;
}

std::tuple<Tensor, Tensor, Tensor, Tensor> range_histogram_backward(Tensor means2d, Tensor conics, Tensor opacities, Tensor rays,
                                                                    Tensor offsets, Tensor flatten_ids, OptionalTensor factors,
                                                                    Tensor gradient_, double nearest, double bin, int64_t bins,
                                                                    int64_t width, int64_t height, double max_alpha) {
  Call call(means2d);
  const Arguments given(call, means2d, conics, opacities, rays, offsets, flatten_ids, factors, nearest, bin, bins, width, height,
                        max_alpha);
  const Tensor gradient = call.floats(gradient_, "gradient");
  check(gradient.numel() == width * bins, "range_histogram_backward: the gradient must be [", width, ", ", bins, "]");
  const int64_t count = given.in.splats.splats.count;
  Tensor v_means2d = call.empty({count, 2}), v_conics = call.empty({count, 3}), v_opacities = call.empty({count}),
         v_rays = call.empty({count, kRayNumbers});
  backward(call, given.in, data(gradient),
           {mutable_data(v_means2d), mutable_data(v_conics), mutable_data(v_opacities), mutable_data(v_rays)});
  call.finish("range_histogram_backward");
  return {v_means2d, v_conics, v_opacities, v_rays};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("range_histogram", GSPLAT_BOX(&range_histogram));
  m.impl("range_histogram_backward", GSPLAT_BOX(&range_histogram_backward));
}

}  // namespace gsplat::range_histogram
