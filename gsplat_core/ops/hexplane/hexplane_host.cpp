// Host code of hexplane_features, its gradient, and the two halves of factorised inference: checks, memory, and the
// launch on each device.
#include <algorithm>
#include <array>
#include <initializer_list>
#include <tuple>
#include <vector>

#include "hexplane.h"
#include "host_call.h"
#if !defined(GSPLAT_CUDA)
#include "threads.h"
#endif

namespace gsplat::hexplane {
namespace {

using Planes = std::initializer_list<const Tensor*>;
using FeatureGradients = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

// Contiguous tensors of one level, which own the memory of the raw pointers.
struct Level {
  Tensor coordinates;
  std::array<Tensor, kPlanes> tensors;
  HexPlanes raw = {};
  int64_t count = 0;

  Level(const Call& call, const Tensor& points, Planes planes, int64_t dims = 3)
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

// Inputs of hexplane_decode, contiguous and checked.
struct DecodeInputs {
  Tensor coordinates;
  std::vector<Tensor> spaces, lines, weights, biases;
  int64_t count = 0, features = 0;

  DecodeInputs(const Call& call, const std::vector<Tensor>& spaces_in, const Tensor& coordinates_in,
               const std::vector<Tensor>& lines_in, const std::vector<Tensor>& weights_in, const std::vector<Tensor>& biases_in)
      : coordinates(call.floats(coordinates_in, "coordinates")) {
    check(!spaces_in.empty() && spaces_in.size() <= kMaxLevels && !weights_in.empty() && weights_in.size() <= kMaxLayers &&
              weights_in.size() == biases_in.size() && (lines_in.empty() || lines_in.size() == 3 * spaces_in.size()),
          "hexplane_decode takes 1 to ", kMaxLevels, " levels, three lines per level or none, and 1 to ", kMaxLayers,
          " layers with a bias each; got ", spaces_in.size(), " levels, ", lines_in.size(), " lines, ", weights_in.size(),
          " weights and ", biases_in.size(), " biases");
    check(coordinates.dim() == 2 && coordinates.size(1) == 4, "coordinates must be [N, 4]");
    count = coordinates.size(0);
    for (const Tensor& t : spaces_in) {
      spaces.push_back(call.floats(t, "space"));
      check(t.dim() == 2 && t.size(0) == count, "every space must be [N, C] with N = ", count);
      features += t.size(1);
    }
    for (size_t i = 0; i < lines_in.size(); ++i) {
      const Tensor& t = lines_in[i];
      lines.push_back(call.floats(t, "line"));
      check(t.dim() == 2 && t.size(0) > 0 && t.size(1) == spaces[i / 3].size(1), "every line must be [U, C] with its level's C");
    }
    int64_t inputs = features;
    for (size_t i = 0; i < weights_in.size(); ++i) {
      weights.push_back(call.floats(weights_in[i], "weight")), biases.push_back(call.floats(biases_in[i], "bias"));
      check(weights[i].dim() == 2 && weights[i].size(1) == inputs && biases[i].numel() == weights[i].size(0), "layer ", i,
            " must take ", inputs, " inputs and have one bias per output");
      inputs = weights[i].size(0);
    }
  }
  int64_t outputs() const { return weights.back().size(0); }
};

#if defined(GSPLAT_CUDA)

void run_product(const Call& call, const Level& level, int last, float* features) {
  plane_product(level.raw, 0, last, features, level.count, call.stream);
}

void run_modulate(const Call& call, const HexPlanes& level, const float* space, float* features, int64_t count) {
  modulate_lines(level, space, features, count, call.stream);
}

void run_backward(Call& call, const Level& level, const float* gradient, float* points, float* const* planes) {
  plane_gradients(level.raw, gradient, points, planes, level.count, call, call.stream);
}

void run_decode(Call& call, const DecodeInputs& in, float* outputs) {
  int64_t inputs = in.features, column = 0;
  float* now = call.array<float>(in.count * inputs);
  for (size_t l = 0; l < in.spaces.size(); ++l) {
    const int64_t channels = in.spaces[l].size(1);
    const float* values = data(in.spaces[l]);
    if (!in.lines.empty()) {
      float* const features = call.array<float>(in.count * channels);
      const Level level(call, in.coordinates, {&in.lines[3 * l], &in.lines[3 * l + 1], &in.lines[3 * l + 2]}, 2);
      run_modulate(call, level.raw, values, features, in.count);
      values = features;
    }
    const size_t row = size_t(channels) * sizeof(float);
    if (in.count > 0 && row > 0)
      check_cuda(cudaMemcpy2DAsync(now + column, size_t(inputs) * sizeof(float), values, row, row, size_t(in.count),
                                   cudaMemcpyDeviceToDevice, call.stream),
                 "putting the levels' features side by side");
    column += channels;
  }
  for (size_t i = 0; i < in.weights.size(); ++i) {
    const int64_t width = in.weights[i].size(0);
    const bool last = i + 1 == in.weights.size();
    float* const next = last ? outputs : call.array<float>(in.count * width);
    linear_layer(now, inputs, data(in.weights[i]), data(in.biases[i]), next, width, in.count, int(inputs), int(width), !last,
                 call.stream);
    now = next, inputs = width;
  }
}

#else

constexpr int64_t kGrain = 512;
constexpr int64_t kChannelChunk = 16;  // channels of one plane that one task sums: one cache line

void run_product(const Call&, const Level& level, int last, float* features) {
  torch::stable::parallel_for(0, level.count, kGrain,
                              [&](int64_t begin, int64_t end) { kernels().product(level.raw, 0, last, features, begin, end); });
}

void run_modulate(const Call&, const HexPlanes& level, const float* space, float* features, int64_t count) {
  torch::stable::parallel_for(0, count, kGrain,
                              [&](int64_t begin, int64_t end) { kernels().modulate(level, space, features, begin, end); });
}

// For each block, points first write the gradient of each plane's sample. Then each task sums its own channels of one
// plane in point order. No two tasks share a cell, so the sums do not depend on the number of threads.
void run_backward(const Call& call, const Level& level, const float* gradient, float* points, float* const* planes) {
  const int64_t channels = level.raw.channels, chunks = (channels + kChannelChunk - 1) / kChannelChunk;
  Tensor memory = call.empty({kPlanes, kBackwardBlock, channels});
  float* const samples = mutable_data(memory);
  for (int p = 0; p < kPlanes; ++p) std::fill_n(planes[p], level.tensors[p].numel(), 0.0f);
  for (int64_t block = 0; block < level.count; block += kBackwardBlock) {
    const int64_t block_end = std::min(level.count, block + kBackwardBlock);
    torch::stable::parallel_for(block, block_end, kBackwardBlock / 16, [&](int64_t begin, int64_t end) {
      kernels().backward_samples(level.raw, gradient, samples, points, block, begin, end);
    });
    torch::stable::parallel_for(0, kPlanes * chunks, 1, [&](int64_t begin, int64_t end) {
      for (int64_t task = begin; task < end; ++task) {
        const int plane = int(task % kPlanes);
        const int64_t first = task / kPlanes * kChannelChunk, last = std::min(channels, first + kChannelChunk);
        kernels().scatter(level.raw, plane, samples, planes[plane], first, last, block, block_end);
      }
    });
  }
}

// Transpose and pad the weights [outputs, inputs] and bias of one layer for the kernel.
DecodeLayer pack(const Tensor& weight, const Tensor& bias, std::vector<float>& storage) {
  const int64_t outputs = weight.size(0), inputs = weight.size(1);
  const int64_t lanes = kernels().lanes, padded = (outputs + lanes - 1) / lanes * lanes;
  storage.assign(size_t(padded * (inputs + 1)), 0.0f);
  const float *w = data(weight), *b = data(bias);
  for (int64_t o = 0; o < outputs; ++o) {
    for (int64_t i = 0; i < inputs; ++i) storage[size_t(i * padded + o)] = w[o * inputs + i];
    storage[size_t(inputs * padded + o)] = b[o];
  }
  return {storage.data(), storage.data() + inputs * padded, inputs, padded};
}

void run_decode(const Call&, const DecodeInputs& in, float* outputs) {
  Decode d = {};
  d.coordinates = data(in.coordinates);
  d.level_count = int(in.spaces.size()), d.layer_count = int(in.weights.size());
  for (size_t l = 0; l < in.spaces.size(); ++l) {
    DecodeLevel& level = d.levels[l];
    level.space = data(in.spaces[l]);
    level.channels = in.spaces[l].size(1);
    for (size_t axis = 0; axis < 3 && !in.lines.empty(); ++axis) {
      level.lines[axis] = data(in.lines[3 * l + axis]);
      level.widths[axis] = int32_t(in.lines[3 * l + axis].size(0));
    }
  }
  std::vector<std::vector<float> > storage(in.weights.size());
  d.stride = in.features;
  for (size_t i = 0; i < in.weights.size(); ++i) {
    d.layers[i] = pack(in.weights[i], in.biases[i], storage[i]);
    d.stride = std::max(d.stride, d.layers[i].padded_outputs);
  }
  d.output_count = in.outputs();
  d.outputs = outputs;
  torch::stable::parallel_for(0, in.count, 16 * kBlockRows, [&](int64_t begin, int64_t end) {
    std::vector<float> buffer(size_t(2 * kBlockRows * d.stride));
    kernels().decode(d, buffer.data(), begin, end);
  });
}

#endif

Tensor product(const Call& call, const Level& level, int last) {
  Tensor features = call.empty({level.count, level.raw.channels});
  run_product(call, level, last, mutable_data(features));
  call.finish("hexplane_features");
  return features;
}

Tensor hexplane_features(Tensor coordinates, Tensor xy, Tensor xz, Tensor yz, Tensor xt, Tensor yt, Tensor zt) {
  const Call call(coordinates);
  return product(call, Level(call, coordinates, {&xy, &xz, &yz, &xt, &yt, &zt}), kPlanes);
}

Tensor hexplane_space(Tensor coordinates, Tensor xy, Tensor xz, Tensor yz) {
  const Call call(coordinates);
  return product(call, Level(call, coordinates, {&xy, &xz, &yz}), 3);
}

Tensor hexplane_modulate(Tensor space, Tensor coordinates, Tensor xt, Tensor yt, Tensor zt) {
  const Call call(coordinates);
  const Level level(call, coordinates, {&xt, &yt, &zt}, 2);
  const Tensor s = call.floats(space, "space");
  check(s.dim() == 2 && s.size(0) == level.count && s.size(1) == level.raw.channels, "space must be [N, C]");
  Tensor features = call.empty({level.count, level.raw.channels});
  run_modulate(call, level.raw, data(s), mutable_data(features), level.count);
  call.finish("hexplane_modulate");
  return features;
}

FeatureGradients hexplane_features_backward(Tensor gradient, Tensor coordinates, Tensor xy, Tensor xz, Tensor yz, Tensor xt,
                                            Tensor yt, Tensor zt) {
  Call call(coordinates);
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
  run_backward(call, level, data(g), mutable_data(points), out.data());
  call.finish("hexplane_features_backward");
  return {points, planes[0], planes[1], planes[2], planes[3], planes[4], planes[5]};
}

Tensor hexplane_decode(std::vector<Tensor> spaces, Tensor coordinates, std::vector<Tensor> lines, std::vector<Tensor> weights,
                       std::vector<Tensor> biases) {
  Call call(coordinates);
  const DecodeInputs in(call, spaces, coordinates, lines, weights, biases);
  Tensor outputs = call.empty({in.count, in.outputs()});
  run_decode(call, in, mutable_data(outputs));
  call.finish("hexplane_decode");
  return outputs;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("hexplane_features", GSPLAT_BOX(&hexplane_features));
  m.impl("hexplane_features_backward", GSPLAT_BOX(&hexplane_features_backward));
  m.impl("hexplane_space", GSPLAT_BOX(&hexplane_space));
  m.impl("hexplane_modulate", GSPLAT_BOX(&hexplane_modulate));
  m.impl("hexplane_decode", GSPLAT_BOX(&hexplane_decode));
}

}  // namespace gsplat::hexplane
