// A second stream beside that of a call, for work that does not wait for each other: each fills what the other leaves idle. In a
// CUDA graph it becomes a second branch.
#pragma once

#include <cuda_runtime.h>

#include <vector>

// What is queued on `stream` comes after what the main stream had when the branch was made. The branch joins the main stream at
// its end at the latest: make it after the memory that it uses.
class CudaBranch {
 public:
  explicit CudaBranch(cudaStream_t main) : stream(own().stream), main_(main) { fork(); }
  ~CudaBranch() { join(); }
  CudaBranch(const CudaBranch&) = delete;
  CudaBranch& operator=(const CudaBranch&) = delete;

  const cudaStream_t stream;

  // What the branch gets from now on waits for what the main stream has so far.
  void fork() const { follow(stream, main_); }
  // What the main stream gets from now on waits for what the branch has so far.
  void join() const { follow(main_, stream); }

 private:
  struct Own {
    cudaStream_t stream = nullptr;
    cudaEvent_t event = nullptr;
  };

  // Of this thread and the current device, made once: another thread may be recording a graph on its own.
  static Own& own() {
    thread_local std::vector<Own> all;
    int device = 0;
    cudaGetDevice(&device);
    if (all.size() <= size_t(device)) all.resize(size_t(device) + 1);
    Own& mine = all[size_t(device)];
    if (mine.stream == nullptr) {
      cudaStreamCreateWithFlags(&mine.stream, cudaStreamNonBlocking);
      cudaEventCreateWithFlags(&mine.event, cudaEventDisableTiming);
    }
    return mine;
  }

  static void follow(cudaStream_t later, cudaStream_t earlier) {
    cudaEventRecord(own().event, earlier);
    cudaStreamWaitEvent(later, own().event, 0);
  }

  cudaStream_t main_;
};
