// The memory of one call of an op on the CPU, and its checks: the counterpart of cuda_call.h.
#pragma once

#include <vector>

#include "tensor_checks.h"

class CpuCall final : public CallArguments<CpuCall> {
 public:
  explicit CpuCall(const Tensor&) {}

  // A contiguous tensor of this type on the CPU.
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

  // Scratch memory, not initialised, as long as this object.
  template <class T>
  T* array(int64_t count) {
    scratch_.push_back(empty({count * int64_t(sizeof(T))}, ScalarType::Byte));
    return static_cast<T*>(scratch_.back().mutable_data_ptr());
  }

  void finish(const char*) const {}  // CUDA asks here whether the launches of the op went well

 private:
  std::vector<Tensor> scratch_;
};
