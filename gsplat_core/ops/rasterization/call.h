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
  size_t size() const { return size_; }
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

// A number that a kernel writes directly to page-locked memory. The host reads it without a copy, and without waiting for
// kernels that are queued later.
class NumberFromGpu {
 public:
  explicit NumberFromGpu(cudaStream_t stream) : stream_(stream), words_(Words::of_thread().next()) { words_[0] = kPending; }
  // The kernel may still run if the call fails. It must not write into the number of the next call.
  ~NumberFromGpu() {
    if (words_[0] == kPending && launched_) cudaStreamSynchronize(stream_);
  }
  NumberFromGpu(const NumberFromGpu&) = delete;
  NumberFromGpu& operator=(const NumberFromGpu&) = delete;

  // Return the memory for a status [kWords] whose first entry is the number, to be written by the next kernel.
  int32_t* written_by_kernel() {
    launched_ = true;
    return const_cast<int32_t*>(words_);
  }
  void set(int32_t number) { words_[0] = number; }

  // Wait for the number, which is not negative. Launch errors must have been checked before.
  int32_t wait() const {
    for (unsigned polls = 1; words_[0] == kPending; ++polls) {
      if (polls % kPollsPerQuery != 0) continue;
      const cudaError_t state = cudaStreamQuery(stream_);
      if (state == cudaErrorNotReady) {
        cudaGetLastError();  // the query is not an error
      } else {
        check_cuda(state, "projecting the Gaussians");
        check(words_[0] != kPending, "the GPU has not reported the length of the tile lists");
      }
    }
    return words_[0];
  }

 private:
  static constexpr int32_t kPending = -1;
  static constexpr int kWords = 4, kNumbers = 2;
  static constexpr unsigned kPollsPerQuery = 4096;

  struct Words {
    int32_t* all = nullptr;
    unsigned used = 0;
    Words() {
      check_cuda(cudaHostAlloc(&all, kNumbers * kWords * sizeof(int32_t), cudaHostAllocPortable | cudaHostAllocMapped),
                 "allocating host memory");
    }
    ~Words() { cudaFreeHost(all); }
    Words(const Words&) = delete;
    Words& operator=(const Words&) = delete;
    static Words& of_thread() {
      static thread_local Words words;
      return words;
    }
    // The numbers of one call do not share their words.
    volatile int32_t* next() { return all + kWords * (used++ % kNumbers); }
  };

  cudaStream_t stream_;
  volatile int32_t* words_;
  bool launched_ = false;
};

}  // namespace gsplat::rasterization
