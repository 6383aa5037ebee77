// Owning wrappers of CUDA streams and events. cuda_build.cu exports their number for the tests.
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
  // Errors are ignored: they would belong to work queued earlier, and the next check reports them. Work still queued on
  // the stream runs to its end.
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

// An event without timing, used only to order streams.
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
