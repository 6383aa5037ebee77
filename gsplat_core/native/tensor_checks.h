// Checks and typed access shared by the op files: what was expected, what came, in one sentence.
#pragma once

#include <initializer_list>

#include "torch_abi.h"

using gsplat::check;
using torch::stable::Tensor;
using ScalarType = torch::headeronly::ScalarType;

// A float32 CPU tensor, made contiguous; the wrappers in Python have checked shapes and broadcast already.
inline Tensor floats(const Tensor& t, const char* name) {
  check(t.is_cpu(), name, " must be on the CPU for this implementation");
  check(t.scalar_type() == ScalarType::Float, name, " must be float32");
  return t.is_contiguous() ? t : torch::stable::contiguous(t);
}

inline Tensor ints(const Tensor& t, const char* name) {
  check(t.is_cpu(), name, " must be on the CPU for this implementation");
  check(t.scalar_type() == ScalarType::Int, name, " must be int32");
  return t.is_contiguous() ? t : torch::stable::contiguous(t);
}

inline Tensor empty_floats(std::initializer_list<int64_t> sizes) {
  return torch::stable::empty(torch::headeronly::IntHeaderOnlyArrayRef(sizes.begin(), sizes.size()), ScalarType::Float);
}

inline Tensor zero_floats(std::initializer_list<int64_t> sizes) {
  Tensor t = empty_floats(sizes);
  return torch::stable::zero_(t);
}

inline Tensor empty_ints(std::initializer_list<int64_t> sizes) {
  return torch::stable::empty(torch::headeronly::IntHeaderOnlyArrayRef(sizes.begin(), sizes.size()), ScalarType::Int);
}

inline const float* data(const Tensor& t) { return t.const_data_ptr<float>(); }
inline float* mutable_data(const Tensor& t) { return t.mutable_data_ptr<float>(); }
