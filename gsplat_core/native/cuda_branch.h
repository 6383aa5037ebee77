// A second stream for work that is independent of the call's stream, so that both can overlap. In a CUDA graph it
// becomes a second branch.
#pragma once

#include <memory>
#include <vector>

#include "cuda_resources.h"

// Work queued on `stream` starts after the work that the main stream had when the branch was constructed. The
// destructor joins the branch into the main stream at the latest. Construct it after allocating the memory it uses, so
// that it is destroyed first.
class CudaBranch {
 public:
  explicit CudaBranch(cudaStream_t main) : CudaBranch(main, of_this_thread()) {}
  // The destructor may run during stack unwinding, so it does not throw. CUDA keeps the error, and the call's finish()
  // reports it.
  ~CudaBranch() { follow(main_, stream); }
  CudaBranch(const CudaBranch&) = delete;
  CudaBranch& operator=(const CudaBranch&) = delete;

  const cudaStream_t stream;

  // Make later work of the branch wait for all work queued so far on the main stream.
  void fork() const { check_cuda(follow(stream, main_), "starting work beside a stream"); }
  // Make later work of the main stream wait for all work queued so far on the branch.
  void join() const { check_cuda(follow(main_, stream), "waiting for work beside a stream"); }

 private:
  struct Resources {
    gsplat::CudaStream stream;
    gsplat::CudaEvent event;
  };

  CudaBranch(cudaStream_t main, const Resources& own) : stream(own.stream.get()), event_(own.event.get()), main_(main) { fork(); }

  // Resources of this thread and the current device, created on first use and destroyed with the thread. They are not
  // shared because another thread may be capturing a graph.
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
