// CUDA streams and events with an owner: they end with the object. cuda_build.cu says how many there are, for the tests.
#pragma once

#include <cuda_runtime.h>

#include <atomic>

#include "cuda_check.h"

namespace gsplat {

inline std::atomic<int> cuda_resources_alive{0};

class CudaStream {
 public:
  CudaStream() {
    check_cuda(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking), "creating a stream");
    ++cuda_resources_alive;
  }
  // A failure here would be that of work queued before, which the next check reports. What is still queued runs to its end.
  ~CudaStream() {
    cudaStreamDestroy(stream_);
    --cuda_resources_alive;
  }
  CudaStream(const CudaStream&) = delete;
  CudaStream& operator=(const CudaStream&) = delete;
  cudaStream_t get() const { return stream_; }

 private:
  cudaStream_t stream_ = nullptr;
};

// An event that only orders streams; it has no time.
class CudaEvent {
 public:
  CudaEvent() {
    check_cuda(cudaEventCreateWithFlags(&event_, cudaEventDisableTiming), "creating an event");
    ++cuda_resources_alive;
  }
  ~CudaEvent() {
    cudaEventDestroy(event_);
    --cuda_resources_alive;
  }
  CudaEvent(const CudaEvent&) = delete;
  CudaEvent& operator=(const CudaEvent&) = delete;
  cudaEvent_t get() const { return event_; }

 private:
  cudaEvent_t event_ = nullptr;
};

}  // namespace gsplat
