#include "cuda_call.h"
#include "scalars_cuda.h"

namespace {

void store_scalars_(Tensor to, std::vector<double> values) {
  CudaCall call(to);
  const int64_t count = int64_t(values.size());
  call.floats(to, "store_scalars_'s target");
  check(to.is_contiguous() && to.numel() == count && count <= kMostScalars,
        "store_scalars_ writes all of a contiguous tensor of at most ", kMostScalars, " values; got ", count, " values for ",
        to.numel());
  if (count == 0) return;
  DeviceScalars scalars = {};
  scalars.count = int(count);
  for (int64_t i = 0; i < count; ++i) scalars.values[i] = float(values[i]);
  store_on_device(mutable_data(to), scalars, call.stream);
  check_cuda(cudaGetLastError(), "store_scalars_");
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) { m.impl("store_scalars_", GSPLAT_BOX(&store_scalars_)); }
