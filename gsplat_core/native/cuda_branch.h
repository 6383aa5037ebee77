// A second stream beside that of a call, for work that does not wait for each other: each fills what the other leaves idle. In a
// CUDA graph it becomes a second branch.
#pragma once

#include <memory>
#include <vector>

#include "cuda_resources.h"

// What is queued on `stream` comes after what the main stream had when the branch was made. The branch joins the main stream at
// its end at the latest: make it after the memory that it uses.
class CudaBranch {
 public:
  explicit CudaBranch(cudaStream_t main) : CudaBranch(main, of_this_thread()) {}
  // The end may come while an exception is thrown, so it throws none: CUDA keeps the error, and the call's finish() reports it.
  ~CudaBranch() { follow(main_, stream); }
  CudaBranch(const CudaBranch&) = delete;
  CudaBranch& operator=(const CudaBranch&) = delete;

  const cudaStream_t stream;

  // What the branch gets from now on waits for what the main stream has so far.
  void fork() const { check_cuda(follow(stream, main_), "starting work beside a stream"); }
  // What the main stream gets from now on waits for what the branch has so far.
  void join() const { check_cuda(follow(main_, stream), "waiting for work beside a stream"); }

 private:
  struct Resources {
    gsplat::CudaStream stream;
    gsplat::CudaEvent event;
  };

  CudaBranch(cudaStream_t main, const Resources& own) : stream(own.stream.get()), event_(own.event.get()), main_(main) { fork(); }

  // Of this thread and the current device, made when first used and gone when the thread ends: another thread may be capturing a
  // graph on its own.
  static const Resources& of_this_thread() {
    thread_local std::vector<std::unique_ptr<Resources>> by_device;
    int device = 0;
    check_cuda(cudaGetDevice(&device), "asking for the current device");
    if (by_device.size() <= size_t(device)) by_device.resize(size_t(device) + 1);
    if (!by_device[size_t(device)]) by_device[size_t(device)] = std::make_unique<Resources>();
    return *by_device[size_t(device)];
  }

  cudaError_t follow(cudaStream_t later, cudaStream_t earlier) const {
    const cudaError_t error = cudaEventRecord(event_, earlier);
    return error != cudaSuccess ? error : cudaStreamWaitEvent(later, event_, 0);
  }

  const cudaEvent_t event_;
  const cudaStream_t main_;
};
