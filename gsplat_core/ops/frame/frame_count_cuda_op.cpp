#include "cuda_call.h"
#include "frame_count_cuda.h"

namespace {

Tensor count_frame_(Tensor status, Tensor most, Tensor step) {
  CudaCall call(status);
  for (const Tensor* t : {&status, &most}) {
    call.ints(*t, "count_frame_'s status");
    check(t->is_contiguous() && t->numel() == kStatusWords, "count_frame_ takes a status of ", kStatusWords,
          " words and the most of each, got ", t->numel());
  }
  call.take(step, ScalarType::Long, "step");
  check(step.numel() == 1, "step is one number");
  Tensor fits = call.empty({1});
  count_frame(status.const_data_ptr<int32_t>(), most.mutable_data_ptr<int32_t>(), step.mutable_data_ptr<int64_t>(),
              mutable_data(fits), call.stream);
  check_cuda(cudaGetLastError(), "count_frame_");
  return fits;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) { m.impl("count_frame_", GSPLAT_BOX(&count_frame_)); }
