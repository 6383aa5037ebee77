// Additions to CudaCall for the op's host code: low-overhead tensor allocation, scratch arrays in one allocation, and
// values read back from the device.
#pragma once

#include <vector>

#include "cuda_call.h"

namespace gsplat::rasterization {

using Sizes = std::vector<int64_t>;

// Allocates uninitialised tensors on a call's device. Equivalent to CudaCall::empty but bypasses torch's dispatcher,
// which would take half of the host time of a forward pass.
class Allocator {
 public:
  explicit Allocator(const Tensor& on) : device_(on.get_device_index()) {}

  Tensor empty(const Sizes& sizes, ScalarType type = ScalarType::Float) const {
    Sizes strides(sizes.size());
    int64_t stride = 1;
    for (size_t i = sizes.size(); i-- > 0;) {
      strides[i] = stride;
      stride *= sizes[i] > 1 ? sizes[i] : 1;
    }
    AtenTensorHandle handle = nullptr;
    check(aoti_torch_empty_strided(int64_t(sizes.size()), sizes.data(), strides.data(), int32_t(type),
                                   aoti_torch_device_type_cuda(), device_, &handle) == 0,
          "torch could not allocate device memory");
    return Tensor(handle);
  }
  Tensor floats(const Sizes& sizes) const { return empty(sizes); }
  Tensor ints(const Sizes& sizes) const { return empty(sizes, ScalarType::Int); }
  Tensor longs(const Sizes& sizes) const { return empty(sizes, ScalarType::Long); }

 private:
  int32_t device_;
};

inline float* float_data(const Tensor& t) { return t.numel() > 0 ? t.mutable_data_ptr<float>() : nullptr; }
inline int32_t* int_data(const Tensor& t) { return t.numel() > 0 ? t.mutable_data_ptr<int32_t>() : nullptr; }
inline int64_t* long_data(const Tensor& t) { return t.numel() > 0 ? t.mutable_data_ptr<int64_t>() : nullptr; }

// Consecutive arrays in one allocation: `place` returns the offset of each array, then `make` allocates.
class Arena {
 public:
  template <class T>
  size_t place(int64_t count) {
    const size_t at = size_;
    size_ += (size_t(count > 0 ? count : 1) * sizeof(T) + 255) / 256 * 256;
    return at;
  }
  void make(const Allocator& memory) {
    tensor_.emplace(memory.empty({int64_t(size_)}, ScalarType::Byte));
    base_ = tensor_->mutable_data_ptr<uint8_t>();
  }
  template <class T>
  T* at(size_t place) const {
    return reinterpret_cast<T*>(base_ + place);
  }

 private:
  size_t size_ = 0;
  uint8_t* base_ = nullptr;
  std::optional<Tensor> tensor_;
};

// A few words of page-locked memory per thread for reads from the device. From pageable memory the driver would need an
// extra copy.
class PinnedWords {
 public:
  static constexpr int kCount = 16;

  PinnedWords() { check_cuda(cudaHostAlloc(&words_, kCount * sizeof(int32_t), cudaHostAllocPortable), "allocating host memory"); }
  ~PinnedWords() { cudaFreeHost(words_); }
  PinnedWords(const PinnedWords&) = delete;
  PinnedWords& operator=(const PinnedWords&) = delete;

  static PinnedWords& of_thread() {
    static thread_local PinnedWords words;
    return words;
  }

  void read(const int32_t* from, int count, cudaStream_t stream) {
    check_cuda(cudaMemcpyAsync(words_, from, size_t(count) * sizeof(int32_t), cudaMemcpyDeviceToHost, stream),
               "reading the length of the lists");
  }
  int32_t operator[](int i) const { return words_[i]; }

 private:
  int32_t* words_ = nullptr;
};

}  // namespace gsplat::rasterization
