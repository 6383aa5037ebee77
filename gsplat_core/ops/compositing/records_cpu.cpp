// What is done once per splat: its record before blending, and the sum of its instances' gradients after.
#include "blocks.h"
#include "passes.h"

namespace GSPLAT_ISA {
namespace {

constexpr float kLog2E = 1.44269504f;

void make_records(const Compositing& in, int64_t begin, int64_t end, SplatRecord* records) {
  const int channels = in.channels;
  for (int64_t first = begin; first < end; first += kLanes) {
    const int n = end - first < kLanes ? int(end - first) : kLanes;
    float logs[kLanes] = {};
    for (int i = 0; i < n; ++i) logs[i] = in.opacities[first + i];
    const vfloat opacity = load(logs);
    store(logs, where(above(opacity, vfloat{}), log2(opacity), splat(-__builtin_inff())));
    for (int i = 0; i < n; ++i) {
      const int64_t splat = first + i;
      const float *mean = in.means2d + 2 * splat, *conic = in.conics + 3 * splat, *color = in.colors + channels * splat;
      SplatRecord& r = records[splat];
      const float a = conic[0], b = conic[1], c = conic[2];
      // Zero times anything that is not finite is not a number.
      float check = 0 * mean[0] + 0 * mean[1] + 0 * a + 0 * b + 0 * c + 0 * in.opacities[splat];
      for (int d = 0; d < channels; ++d) check += 0 * color[d];
      const bool usable = check == 0;
      const bool indefinite = !(a >= 0 && c >= 0 && a * c - b * b >= 0);
      r.x = usable ? mean[0] : 0;
      r.y = usable ? mean[1] : 0;
      r.a = usable ? -0.5f * kLog2E * a : 0;
      r.b = usable ? -kLog2E * b : 0;
      r.c = usable ? -0.5f * kLog2E * c : 0;
      r.l = usable ? logs[i] : -__builtin_inff();
      r.cap = indefinite ? r.l : __builtin_inff();
      r.unused = 0;
      if (channels <= kMostRecorded)
        for (int d = 0; d < channels; ++d) r.colors[d] = color[d];
    }
  }
}

// Colours (forward) or their gradients (backward) of a window; then, in the backward pass, a splat's sums by lane and in all.
int64_t scratch_floats(int channels) { return int64_t(channels) * (kPixels + kLanes + 1); }

void gather(const Compositing& in, const CompositingGradients& from, const int32_t* first, int64_t begin, int64_t end,
            float* v_means2d, float* v_conics, float* v_colors, float* v_opacities, float* v_means2d_abs) {
  const int channels = in.channels;
  for (int64_t splat = begin; splat < end; ++splat) {
    float m[kMoments] = {}, absolute[2] = {};
    float* const v_color = v_colors + channels * splat;
    for (int d = 0; d < channels; ++d) v_color[d] = 0;
    const bool usable = in.records[splat].l > -__builtin_inff();
    for (int64_t i = first[splat]; usable && i < first[splat + 1]; ++i) {
      const float* const row = from.rows + i * from.row_size;
      for (int r = 0; r < kMoments; ++r) m[r] += row[r];
      for (int d = 0; d < channels; ++d) v_color[d] += row[kMoments + d];
      if (from.absgrad)
        for (int r = 0; r < 2; ++r) absolute[r] += row[kMoments + channels + r];
    }
    const float a = usable ? in.conics[3 * splat] : 0, b = usable ? in.conics[3 * splat + 1] : 0;
    const float c = usable ? in.conics[3 * splat + 2] : 0;
    v_means2d[2 * splat] = a * m[1] + b * m[2];
    v_means2d[2 * splat + 1] = b * m[1] + c * m[2];
    v_conics[3 * splat] = -0.5f * m[3];
    v_conics[3 * splat + 1] = -m[4];
    v_conics[3 * splat + 2] = -0.5f * m[5];
    v_opacities[splat] = usable ? m[0] / in.opacities[splat] : 0;
    for (int r = 0; from.absgrad && r < 2; ++r) v_means2d_abs[2 * splat + r] = absolute[r];
  }
}

}  // namespace

extern const CompositingKernels compositing_kernels = {make_records, scratch_floats, composite_tile, composite_tile_backward,
                                                       gather};

}  // namespace GSPLAT_ISA
