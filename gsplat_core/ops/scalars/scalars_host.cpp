#include "scalars.h"

#include <vector>

#include "host_call.h"

namespace gsplat::scalars {
namespace {

void store(const Call& call, const Tensor& to, const Scalars& scalars) {
#if defined(GSPLAT_CUDA)
  store_on_device(mutable_data(to), scalars, call.stream);
#else
  (void)call;
  std::copy(scalars.values, scalars.values + scalars.count, mutable_data(to));
#endif
}

void store_scalars_(Tensor to, std::vector<double> values) {
  const Call call(to);
  call.in_place(to, "store_scalars_'s target");
  const int64_t count = int64_t(values.size());
  check(to.numel() == count && count <= kMostScalars, "store_scalars_ writes all of a tensor of at most ", kMostScalars,
        " values; got ", count, " values for ", to.numel());
  if (count == 0) return;
  Scalars scalars = {};
  scalars.count = int(count);
  for (int64_t i = 0; i < count; ++i) scalars.values[i] = float(values[i]);
  store(call, to, scalars);
  call.finish("store_scalars_");
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) { m.impl("store_scalars_", GSPLAT_BOX(&store_scalars_)); }

}  // namespace gsplat::scalars
