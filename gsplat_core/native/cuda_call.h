// The device, the stream and the memory of one call of a CUDA op, and its checks: the counterpart of tensor_checks.h.
#pragma once

#include <cuda_runtime.h>

#include <vector>

#include "cuda_scratch.h"
#include "tensor_checks.h"

extern "C" AOTITorchError aoti_torch_get_current_cuda_stream(int32_t device_index, void** ret_stream);

inline void check_cuda(cudaError_t error, const char* what) {
  check(error == cudaSuccess, what, ": CUDA says ", cudaGetErrorString(error));
}

// Makes the device of a tensor current and takes torch's current stream there. Scratch memory comes from torch's allocator, which
// hands it out again in the order of the stream, and lasts as long as this object.
class CudaCall final : public CudaScratch {
 public:
  explicit CudaCall(const Tensor& on) : on_(on), guard_(on.get_device_index()) {
    void* current = nullptr;
    check(aoti_torch_get_current_cuda_stream(on.get_device_index(), &current) == 0, "torch has no current CUDA stream");
    stream = static_cast<cudaStream_t>(current);
  }

  cudaStream_t stream;

  // A contiguous tensor of this type on the device of the call.
  Tensor take(const Tensor& t, ScalarType type, const char* name) const {
    check(t.is_cuda() && t.get_device_index() == on_.get_device_index(), name,
          " must be on the same CUDA device as the other tensors");
    check(t.scalar_type() == type, name, " has the wrong type for the CUDA implementation");
    return t.is_contiguous() ? t : torch::stable::contiguous(t);
  }
  Tensor floats(const Tensor& t, const char* name) const { return take(t, ScalarType::Float, name); }
  Tensor ints(const Tensor& t, const char* name) const { return take(t, ScalarType::Int, name); }

  Tensor empty(std::initializer_list<int64_t> sizes, ScalarType type = ScalarType::Float) const {
    return torch::stable::new_empty(on_, torch::headeronly::IntHeaderOnlyArrayRef(sizes.begin(), sizes.size()), type);
  }

  void* bytes(size_t count) override {
    scratch_.push_back(empty({int64_t(count)}, ScalarType::Byte));
    return scratch_.back().mutable_data_ptr<uint8_t>();
  }

 private:
  Tensor on_;
  torch::stable::accelerator::DeviceGuard guard_;
  std::vector<Tensor> scratch_;
};
