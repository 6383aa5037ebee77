// Checked conversion of a field's tensors to the arguments of its CUDA kernels; shared by inference and training.
#pragma once

#include <vector>

#include "cuda_call.h"
#include "network.h"

namespace gsplat::hexplane {

// Return a contiguous float32 tensor on the call's device, aligned to 16 bytes for the kernels' wide loads. A
// misaligned view is copied.
inline Tensor aligned_floats(const CudaCall& call, const Tensor& t, const char* name) {
  const Tensor c = call.floats(t, name);
  return reinterpret_cast<uintptr_t>(c.const_data_ptr()) % 16 == 0 ? c : torch::stable::clone(c);
}

// Return the network's layers. The tensors are made contiguous in place, and must outlive the result.
inline FieldNetwork network_of(const CudaCall& call, std::vector<Tensor>& weights, std::vector<Tensor>& biases,
                               int64_t features) {
  check(weights.size() >= 2 && weights.size() <= size_t(kMaxFieldLayers) && weights.size() == biases.size(),
        "the network must have 2 to ", kMaxFieldLayers, " layers with a bias each, got ", weights.size(), " weights and ",
        biases.size(), " biases");
  FieldNetwork net = {};
  net.layers = int32_t(weights.size());
  net.features = int32_t(features);
  net.width = int32_t(weights[0].size(0));
  int64_t inputs = features;
  for (size_t i = 0; i < weights.size(); ++i) {
    weights[i] = call.floats(weights[i], "a weight"), biases[i] = call.floats(biases[i], "a bias");
    const int64_t outputs = i + 1 < weights.size() ? net.width : kHeadOutputs;
    check(weights[i].dim() == 2 && weights[i].size(0) == outputs && weights[i].size(1) == inputs && biases[i].numel() == outputs,
          "layer ", int64_t(i), " must be [", outputs, ", ", inputs, "] with one bias per output");
    net.weights[i] = data(weights[i]), net.biases[i] = data(biases[i]);
    inputs = outputs;
  }
  return net;
}

// Set the time planes (three per level, [V, U, C]) and the offsets of their lines at one time. Returns the lines' size
// in items.
inline int64_t lines_of(const CudaCall& call, std::vector<Tensor>& planes, int64_t channels, FieldTimePlanes& times,
                        FieldLines& lines) {
  int64_t size = 0;
  for (size_t i = 0; i < planes.size(); ++i) {
    Tensor& plane = planes[i];
    plane = call.floats(plane, "a time plane");
    check(plane.dim() == 3 && plane.size(2) == channels && plane.numel() > 0, "every time plane must be [V, U, ", channels,
          "], none empty");
    times.values[i / 3][i % 3] = data(plane);
    times.rows[i / 3][i % 3] = int32_t(plane.size(0));
    lines.widths[i / 3][i % 3] = int32_t(plane.size(1));
    lines.starts[i / 3][i % 3] = size;
    size += plane.size(1) * channels;
  }
  return size;
}

}  // namespace gsplat::hexplane
