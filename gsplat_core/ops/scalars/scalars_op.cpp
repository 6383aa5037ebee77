#include <vector>

#include "cpu_call.h"

static void store_scalars_(Tensor to, std::vector<double> values) {
  floats(to, "store_scalars_'s target");
  check(to.is_contiguous() && to.numel() == int64_t(values.size()), "store_scalars_ writes all of a contiguous tensor; got ",
        values.size(), " values for ", to.numel());
  for (size_t i = 0; i < values.size(); ++i) mutable_data(to)[i] = float(values[i]);
}

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CPU, m) { m.impl("store_scalars_", GSPLAT_BOX(&store_scalars_)); }
