// Host code of splat_regression and its backward pass: checks, memory, and the launch on each device.
#include <algorithm>
#include <tuple>
#include <vector>

#include "host_call.h"
#include "splat_regression.h"

namespace gsplat::splat_regression {
namespace {

struct Arguments {
  Tensor points, centres, factors, values;
  Inputs in;

  Arguments(const Call& call, const Tensor& points_, const Tensor& centres_, const Tensor& factors_, const Tensor& values_)
      : points(call.floats(points_, "points")),
        centres(call.floats(centres_, "centres")),
        factors(call.floats(factors_, "factors")),
        values(call.floats(values_, "values")) {
    check(points.dim() == 2 && centres.dim() == 2 && factors.dim() == 3 && values.dim() == 2,
          "splat_regression takes points [n, d], centres [k, d], factors [k, d, d] and values [k, m]");
    const int64_t dims = points.size(1), splats = centres.size(0);
    check(dims >= 1 && dims <= kMaxDims, "splat_regression: points must have 1 to ", kMaxDims, " dimensions, got ", dims);
    check(centres.size(1) == dims && factors.size(0) == splats && factors.size(1) == dims && factors.size(2) == dims &&
              values.size(0) == splats,
          "splat_regression: centres [k, d], factors [k, d, d] and values [k, m] must have k = ", splats, " and d = ", dims);
    check(values.size(1) < (1 << 17) && points.size(0) < (int64_t(1) << 31) && splats < (int64_t(1) << 31),
          "splat_regression: too many points, splats or channels");
    in = {.points = data(points),
          .centres = data(centres),
          .factors = data(factors),
          .values = data(values),
          .count = points.size(0),
          .splats = splats,
          .dims = int32_t(dims),
          .channels = int32_t(values.size(1))};
  }
};

#if defined(GSPLAT_CUDA)

void forward(Call& call, const Inputs& in, float* out) { regress_on_device(in, out, call, call.stream); }

void backward(Call& call, const Inputs& in, const float* gradient, const Gradients& out) {
  regress_backward_on_device(in, gradient, out, call, call.stream);
}

#else

constexpr int64_t kPoints = 64 * kRowPadding;  // per task
constexpr int64_t kSplats = 4;

// Copy `from` [count, columns] to `to` [columns, stride], with zeros after each row.
void transpose(const float* from, int64_t count, int64_t columns, int64_t stride, float* to) {
  for (int64_t c = 0; c < columns; ++c) {
    for (int64_t i = 0; i < count; ++i) to[c * stride + i] = from[i * columns + c];
    std::fill(to + c * stride + count, to + (c + 1) * stride, 0.0f);
  }
}

Rows rows_of(Call& call, const Inputs& in) {
  Splat* const records = call.array<Splat>(std::max<int64_t>(in.splats, 1));
  torch::stable::parallel_for(0, in.splats, 256, [&](int64_t begin, int64_t end) { kernels().records(in, begin, end, records); });
  const int64_t stride = (in.count + kRowPadding - 1) / kRowPadding * kRowPadding;
  float* const points = call.array<float>(std::max<int64_t>(in.dims * stride, 1));
  transpose(in.points, in.count, in.dims, stride, points);
  return {records, points, stride};
}

void forward(Call& call, const Inputs& in, float* out) {
  const Rows rows = rows_of(call, in);
  float* const transposed = call.array<float>(std::max<int64_t>(in.channels * rows.stride, 1));
  torch::stable::parallel_for(0, (rows.stride + kPoints - 1) / kPoints, 1, [&](int64_t begin, int64_t end) {
    kernels().forward(in, rows, begin * kPoints, std::min(end * kPoints, rows.stride), transposed);
  });
  for (int64_t c = 0; c < in.channels; ++c)
    for (int64_t i = 0; i < in.count; ++i) out[i * in.channels + c] = transposed[c * rows.stride + i];
}

void backward(Call& call, const Inputs& in, const float* gradient, const Gradients& out) {
  const Rows rows = rows_of(call, in);
  float* const transposed = call.array<float>(std::max<int64_t>(in.channels * rows.stride, 1));
  transpose(gradient, in.count, in.channels, rows.stride, transposed);
  torch::stable::parallel_for(0, in.splats, kSplats, [&](int64_t begin, int64_t end) {
    std::vector<float> lanes(size_t(in.channels * kRowPadding));
    std::vector<double> sums(size_t(moments_of(in.dims) + in.channels));
    kernels().backward(in, rows, transposed, begin, end, out, lanes.data(), sums.data());
  });
}

#endif

Tensor splat_regression(Tensor points, Tensor centres, Tensor factors, Tensor values) {
  Call call(points);
  const Arguments given(call, points, centres, factors, values);
  Tensor out = call.empty({given.in.count, given.in.channels});
  forward(call, given.in, mutable_data(out));
  call.finish("splat_regression");
  return out;
}

std::tuple<Tensor, Tensor, Tensor> splat_regression_backward(Tensor points, Tensor centres, Tensor factors, Tensor values,
                                                             Tensor gradient_) {
  Call call(points);
  const Arguments given(call, points, centres, factors, values);
  const Inputs& in = given.in;
  const Tensor gradient = call.floats(gradient_, "gradient");
  check(gradient.numel() == in.count * in.channels, "splat_regression_backward: the gradient must be [", in.count, ", ",
        in.channels, "] as the values at the points are");
  Tensor v_centres = call.empty({in.splats, in.dims}), v_factors = call.empty({in.splats, in.dims, in.dims}),
         v_values = call.empty({in.splats, in.channels});
  backward(call, in, data(gradient), {mutable_data(v_centres), mutable_data(v_factors), mutable_data(v_values)});
  call.finish("splat_regression_backward");
  return {v_centres, v_factors, v_values};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("splat_regression", GSPLAT_BOX(&splat_regression));
  m.impl("splat_regression_backward", GSPLAT_BOX(&splat_regression_backward));
}

}  // namespace gsplat::splat_regression
