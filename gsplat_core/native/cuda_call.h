// Device, stream, memory and argument checks of one CUDA op call; the counterpart of cpu_call.h.
#pragma once

#include <cuda_runtime.h>

#include <vector>

#include "cuda_check.h"
#include "cuda_scratch.h"
#include "tensor_checks.h"

extern "C" AOTITorchError aoti_torch_get_current_cuda_stream(int32_t device_index, void** ret_stream);

// Makes the device of a tensor current and uses torch's current stream there. Scratch memory comes from torch's
// stream-ordered caching allocator and is freed with this object.
class CudaCall final : public CudaScratch, public CallArguments<CudaCall> {
 public:
  explicit CudaCall(const Tensor& on) : on_(on), guard_(on.get_device_index()) {
    void* current = nullptr;
    TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(on.get_device_index(), &current));
    stream = static_cast<cudaStream_t>(current);
  }

  cudaStream_t stream;

  // Return `t` as a contiguous tensor, after checking its dtype and that it is on the call's device.
  Tensor take(const Tensor& t, ScalarType type, const char* name) const {
    check(t.is_cuda() && t.get_device_index() == on_.get_device_index(), name,
          " must be on the same CUDA device as the other tensors");
    return contiguous(t, type, name);
  }

  Tensor empty(std::initializer_list<int64_t> sizes, ScalarType type = ScalarType::Float) const {
    return torch::stable::new_empty(on_, torch::headeronly::IntHeaderOnlyArrayRef(sizes.begin(), sizes.size()), type);
  }
  Tensor zeros(std::initializer_list<int64_t> sizes, ScalarType type = ScalarType::Float) const {
    Tensor t = empty(sizes, type);
    const size_t bytes = size_t(t.numel()) * size_t(t.element_size());
    if (bytes > 0) check_cuda(cudaMemsetAsync(t.mutable_data_ptr(), 0, bytes, stream), "setting memory to zero");
    return t;
  }

  void* bytes(size_t count) override {
    scratch_.push_back(empty({int64_t(count)}, ScalarType::Byte));
    return scratch_.back().mutable_data_ptr<uint8_t>();
  }

  // Throw CUDA's error message if a launch of `op` has failed.
  void finish(const char* op) const { check_cuda(cudaGetLastError(), op); }

 private:
  Tensor on_;
  torch::stable::accelerator::DeviceGuard guard_;
  std::vector<Tensor> scratch_;
};
