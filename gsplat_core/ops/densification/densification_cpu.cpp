#include "densification.h"
#include "densification_math.h"
#include "simd.h"
#include "transposed_rows.h"

namespace GSPLAT_ISA::densification {

using gsplat::densification::Diffusion;
using gsplat::densification::Statistics;

static void accumulate(const Statistics& s, int64_t begin, int64_t end) {
  for (int64_t i = begin; i < end; ++i) {
    float sum = 0, seen = 0;
    int32_t widest = 0;
    for (int64_t image = 0; image < s.images; ++image) {
      const int64_t at = 2 * (image * s.count + i);
      const int32_t across = s.radii[at], down = s.radii[at + 1];
      if (across <= 0 || down <= 0) continue;
      const float x = s.gradients[at] * s.scale_x, y = s.gradients[at + 1] * s.scale_y;
      sum += __builtin_sqrtf(x * x + y * y);
      seen += 1;
      const int32_t wider = across > down ? across : down;
      widest = wider > widest ? wider : widest;
    }
    s.sums[i] += sum;
    s.counts[i] += seen;
    if (s.largest != nullptr) {
      const float extent = float(widest) * s.extent_scale;
      if (extent > s.largest[i]) s.largest[i] = extent;
    }
  }
}

static void diffuse(const Diffusion& d, int64_t begin, int64_t end) {
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    vfloat mean[3], quat[4], log_scales[3], logit, noise[3];
    load_rows<3>(d.means, first, count, mean);
    load_rows<4>(d.quats, first, count, quat);
    load_rows<3>(d.log_scales, first, count, log_scales);
    load_rows<1>(d.logits, first, count, &logit);
    load_rows<3>(d.noise, first, count, noise);
    diffused(mean, quat, log_scales, logit, noise, d.scale, d.opacity_at_half, d.steepness);
    store_rows<3>(d.means, first, count, mean);
  }
}

extern const gsplat::densification::Kernels kernels = {accumulate, diffuse};

}  // namespace GSPLAT_ISA::densification
