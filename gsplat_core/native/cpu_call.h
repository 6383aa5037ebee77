// Memory and argument checks of one op call on the CPU; the counterpart of cuda_call.h.
#pragma once

#include <vector>

#include "tensor_checks.h"

class CpuCall final : public CallArguments<CpuCall> {
 public:
  explicit CpuCall(const Tensor&) {}

  // Return `t` as a contiguous CPU tensor, after checking its dtype.
  Tensor take(const Tensor& t, ScalarType type, const char* name) const {
    check(t.is_cpu(), name, " must be on the CPU like the other tensors");
    return contiguous(t, type, name);
  }

  Tensor empty(std::initializer_list<int64_t> sizes, ScalarType type = ScalarType::Float) const {
    return torch::stable::empty(torch::headeronly::IntHeaderOnlyArrayRef(sizes.begin(), sizes.size()), type);
  }
  Tensor zeros(std::initializer_list<int64_t> sizes, ScalarType type = ScalarType::Float) const {
    Tensor t = empty(sizes, type);
    return torch::stable::zero_(t);
  }

  // Uninitialised scratch memory, freed with this object.
  template <class T>
  T* array(int64_t count) {
    scratch_.push_back(empty({count * int64_t(sizeof(T))}, ScalarType::Byte));
    return static_cast<T*>(scratch_.back().mutable_data_ptr());
  }

  void finish(const char*) const {}  // the CUDA version reports launch errors here

 private:
  std::vector<Tensor> scratch_;
};
