#include <algorithm>
#include <vector>

#include "cpu_call.h"
#include "hexplane_decode.h"

// Weights [outputs, inputs] and bias of one layer, transposed and padded for the kernel.
static DecodeLayer pack(const Tensor& weight, const Tensor& bias, std::vector<float>& storage) {
  const int64_t outputs = weight.size(0), inputs = weight.size(1);
  const int64_t lanes = decode_kernels().lanes, padded = (outputs + lanes - 1) / lanes * lanes;
  storage.assign(size_t(padded * (inputs + 1)), 0.0f);
  const float *w = data(weight), *b = data(bias);
  for (int64_t o = 0; o < outputs; ++o) {
    for (int64_t i = 0; i < inputs; ++i) storage[size_t(i * padded + o)] = w[o * inputs + i];
    storage[size_t(inputs * padded + o)] = b[o];
  }
  return {storage.data(), storage.data() + inputs * padded, inputs, padded};
}

static Tensor hexplane_decode(std::vector<Tensor> spaces, Tensor coordinates, std::vector<Tensor> lines,
                              std::vector<Tensor> weights, std::vector<Tensor> biases) {
  check(!spaces.empty() && spaces.size() <= kMaxLevels && !weights.empty() && weights.size() <= kMaxLayers &&
            weights.size() == biases.size() && (lines.empty() || lines.size() == 3 * spaces.size()),
        "hexplane_decode takes 1 to 16 levels, three lines per level or none, and 1 to 66 layers with a bias each");
  const Tensor points = floats(coordinates, "coordinates");
  const int64_t n = points.size(0);
  check(points.dim() == 2 && points.size(1) == 4, "coordinates must be [N, 4]");
  Decode d = {};
  d.coordinates = data(points);
  d.level_count = int(spaces.size()), d.layer_count = int(weights.size());
  int64_t features = 0;
  for (size_t l = 0; l < spaces.size(); ++l) {
    spaces[l] = floats(spaces[l], "space");
    check(spaces[l].dim() == 2 && spaces[l].size(0) == n, "every space must be [N, C]");
    DecodeLevel& level = d.levels[l];
    level.space = data(spaces[l]);
    level.channels = spaces[l].size(1);
    features += level.channels;
    for (size_t axis = 0; axis < 3 && !lines.empty(); ++axis) {
      Tensor& line = lines[3 * l + axis];
      line = floats(line, "line");
      check(line.dim() == 2 && line.size(0) > 0 && line.size(1) == level.channels, "every line must be [U, C]");
      level.lines[axis] = data(line);
      level.widths[axis] = int32_t(line.size(0));
    }
  }
  std::vector<std::vector<float>> storage(weights.size());
  int64_t inputs = features;
  d.stride = features;
  for (size_t i = 0; i < weights.size(); ++i) {
    weights[i] = floats(weights[i], "weight"), biases[i] = floats(biases[i], "bias");
    check(weights[i].dim() == 2 && weights[i].size(1) == inputs && biases[i].numel() == weights[i].size(0), "layer ", int64_t(i),
          " must take ", inputs, " inputs and have one bias per output");
    d.layers[i] = pack(weights[i], biases[i], storage[i]);
    inputs = weights[i].size(0);
    d.stride = std::max(d.stride, d.layers[i].padded_outputs);
  }
  d.output_count = inputs;
  Tensor outputs = empty_floats({n, inputs});
  d.outputs = mutable_data(outputs);
  torch::stable::parallel_for(0, n, 16 * kBlockRows, [&](int64_t begin, int64_t end) {
    std::vector<float> buffer(size_t(2 * kBlockRows * d.stride));
    decode_kernels().decode(d, buffer.data(), begin, end);
  });
  return outputs;
}

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CPU, m) { m.impl("hexplane_decode", GSPLAT_BOX(&hexplane_decode)); }
