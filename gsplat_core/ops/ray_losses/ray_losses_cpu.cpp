// Losses along rays, row by row.
#include "ray_losses_math.h"

namespace GSPLAT_ISA::ray_losses {

static void depth_terms(const DepthLoss& loss, Sums* rows, int64_t begin, int64_t end) {
  for (int64_t y = begin; y < end; ++y) {
    Sums sums = {0, 0};
    for (int64_t at = y * loss.width; at < (y + 1) * loss.width; ++at) {
      const DepthTerm term = depth_term(loss, at);
      sums.terms += double(term.off);
      sums.divisor += double(term.inverse);
    }
    rows[y] = sums;
  }
}

static void depth_gradients(const DepthLoss& loss, float scale, int64_t begin, int64_t end) {
  for (int64_t at = begin * loss.width; at < end * loss.width; ++at) loss.v_depths[at] = scale * depth_term(loss, at).slope;
}

static void normal_terms(const NormalLoss& loss, Sums* rows, int64_t begin, int64_t end) {
  for (int64_t y = begin; y < end; ++y) {
    Sums sums = {0, 0};
    for (int x = 0; x < loss.width; ++x) {
      sums.terms += double(write_normal_term(loss, x, int(y)));
      sums.divisor += loss.bits[y * loss.width + x] & kCompared;
    }
    rows[y] = sums;
  }
}

static void normal_gradients(const NormalLoss& loss, float scale, int64_t begin, int64_t end) {
  for (int64_t y = begin; y < end; ++y)
    for (int x = 0; x < loss.width; ++x) write_normal_gradient(loss, scale, x, int(y));
}

extern const Kernels kernels = {depth_terms, depth_gradients, normal_terms, normal_gradients};

}  // namespace GSPLAT_ISA::ray_losses
