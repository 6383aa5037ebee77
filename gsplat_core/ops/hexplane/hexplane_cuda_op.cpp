#include <array>
#include <initializer_list>
#include <tuple>
#include <vector>

#include "cuda_call.h"
#include "hexplane_cuda.h"
#include "hexplane_decode.h"

namespace {

// Contiguous tensors of one level, kept alive beside the raw pointers.
struct Level {
  Tensor coordinates;
  std::array<Tensor, kPlanes> tensors;
  HexPlanes raw = {};
  int64_t count = 0;

  Level(const CudaCall& call, const Tensor& points, std::initializer_list<const Tensor*> planes, int64_t dims = 3)
      : coordinates(call.floats(points, "coordinates")) {
    check(coordinates.dim() == 2 && coordinates.size(1) == 4, "coordinates must be [N, 4]");
    count = coordinates.size(0);
    raw.coordinates = data(coordinates);
    raw.channels = (*planes.begin())->size(dims - 1);
    int i = 0;
    for (const Tensor* plane : planes) {
      check(plane->dim() == dims && plane->size(dims - 1) == raw.channels && plane->numel() > 0,
            "every plane must be [V, U, C] (a line [U, C]) with the same C, none empty");
      tensors[i] = call.floats(*plane, "a plane");
      raw.planes[i] = {data(tensors[i]), int32_t(plane->size(dims - 2)), dims == 3 ? int32_t(plane->size(0)) : 1};
      ++i;
    }
  }
};

Tensor product(const CudaCall& call, const Level& level, int last) {
  Tensor features = call.empty({level.count, level.raw.channels});
  plane_product(level.raw, 0, last, mutable_data(features), level.count, call.stream);
  check_cuda(cudaGetLastError(), "hexplane features");
  return features;
}

Tensor hexplane_features(Tensor coordinates, Tensor xy, Tensor xz, Tensor yz, Tensor xt, Tensor yt, Tensor zt) {
  const CudaCall call(coordinates);
  return product(call, Level(call, coordinates, {&xy, &xz, &yz, &xt, &yt, &zt}), kPlanes);
}

Tensor hexplane_space(Tensor coordinates, Tensor xy, Tensor xz, Tensor yz) {
  const CudaCall call(coordinates);
  return product(call, Level(call, coordinates, {&xy, &xz, &yz}), 3);
}

Tensor hexplane_modulate(Tensor space, Tensor coordinates, Tensor xt, Tensor yt, Tensor zt) {
  const CudaCall call(coordinates);
  const Level level(call, coordinates, {&xt, &yt, &zt}, 2);
  const Tensor s = call.floats(space, "space");
  check(s.dim() == 2 && s.size(0) == level.count && s.size(1) == level.raw.channels, "space must be [N, C]");
  Tensor features = call.empty({level.count, level.raw.channels});
  modulate_lines(level.raw, data(s), mutable_data(features), level.count, call.stream);
  check_cuda(cudaGetLastError(), "hexplane_modulate");
  return features;
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> hexplane_features_backward(Tensor gradient, Tensor coordinates,
                                                                                              Tensor xy, Tensor xz, Tensor yz,
                                                                                              Tensor xt, Tensor yt, Tensor zt) {
  CudaCall call(coordinates);
  const Level level(call, coordinates, {&xy, &xz, &yz, &xt, &yt, &zt});
  const Tensor g = call.floats(gradient, "gradient");
  check(g.dim() == 2 && g.size(0) == level.count && g.size(1) == level.raw.channels, "the gradient must be [N, C]");
  Tensor points = call.empty({level.count, 4});
  std::array<Tensor, kPlanes> planes;
  std::array<float*, kPlanes> out;
  for (int p = 0; p < kPlanes; ++p) {
    planes[p] = call.empty({level.tensors[p].size(0), level.tensors[p].size(1), level.raw.channels});
    out[p] = mutable_data(planes[p]);
  }
  plane_gradients(level.raw, data(g), mutable_data(points), out.data(), level.count, call, call.stream);
  check_cuda(cudaGetLastError(), "hexplane_features_backward");
  return {points, planes[0], planes[1], planes[2], planes[3], planes[4], planes[5]};
}

Tensor hexplane_decode(std::vector<Tensor> spaces, Tensor coordinates, std::vector<Tensor> lines, std::vector<Tensor> weights,
                       std::vector<Tensor> biases) {
  CudaCall call(coordinates);
  check(!spaces.empty() && spaces.size() <= kMaxLevels && !weights.empty() && weights.size() <= kMaxLayers &&
            weights.size() == biases.size() && (lines.empty() || lines.size() == 3 * spaces.size()),
        "hexplane_decode takes 1 to 16 levels, three lines per level or none, and 1 to 66 layers with a bias each");
  const int64_t n = coordinates.size(0);
  int64_t inputs = 0;
  std::vector<Tensor> values;
  for (size_t l = 0; l < spaces.size(); ++l) {
    const Tensor s = call.floats(spaces[l], "space");
    check(s.dim() == 2 && s.size(0) == n, "every space must be [N, C]");
    values.push_back(lines.empty() ? s : hexplane_modulate(s, coordinates, lines[3 * l], lines[3 * l + 1], lines[3 * l + 2]));
    inputs += s.size(1);
  }
  float* now = call.array<float>(n * inputs);
  int64_t column = 0;
  for (const Tensor& value : values) {
    const size_t row = size_t(value.size(1)) * sizeof(float);
    if (n > 0 && row > 0)
      check_cuda(cudaMemcpy2DAsync(now + column, size_t(inputs) * sizeof(float), data(value), row, row, size_t(n),
                                   cudaMemcpyDeviceToDevice, call.stream),
                 "hexplane_decode");
    column += value.size(1);
  }
  for (size_t i = 0; i < weights.size(); ++i) {
    const Tensor weight = call.floats(weights[i], "weight"), bias = call.floats(biases[i], "bias");
    check(weight.dim() == 2 && weight.size(1) == inputs && bias.numel() == weight.size(0), "layer ", int64_t(i), " must take ",
          inputs, " inputs and have one bias per output");
    const int64_t outputs = weight.size(0);
    const bool last = i + 1 == weights.size();
    Tensor result;
    if (last) result = call.empty({n, outputs});
    float* next = last ? mutable_data(result) : call.array<float>(n * outputs);
    linear_layer(now, inputs, data(weight), data(bias), next, outputs, n, int(inputs), int(outputs), !last, call.stream);
    check_cuda(cudaGetLastError(), "hexplane_decode");
    if (last) return result;
    now = next, inputs = outputs;
  }
  return call.empty({n, inputs});  // not reached: there is a layer
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("hexplane_features", GSPLAT_BOX(&hexplane_features));
  m.impl("hexplane_features_backward", GSPLAT_BOX(&hexplane_features_backward));
  m.impl("hexplane_space", GSPLAT_BOX(&hexplane_space));
  m.impl("hexplane_modulate", GSPLAT_BOX(&hexplane_modulate));
  m.impl("hexplane_decode", GSPLAT_BOX(&hexplane_decode));
}
