#include "adam.h"
#include "simd.h"

namespace GSPLAT_ISA {

static void step(float* p, const float* g, float* m, float* v, int64_t n, float rate, float inv_bias2, float beta1, float beta2,
                 float epsilon) {
  for (int64_t i = 0; i < n; ++i) {
    const float gi = g[i];
    const float mi = m[i] += (1 - beta1) * (gi - m[i]);
    const float vi = v[i] += (1 - beta2) * (gi * gi - v[i]);
    p[i] -= rate * mi / (__builtin_sqrtf(vi) * inv_bias2 + epsilon);
  }
}

extern const AdamKernels adam_kernels = {step};

}  // namespace GSPLAT_ISA
