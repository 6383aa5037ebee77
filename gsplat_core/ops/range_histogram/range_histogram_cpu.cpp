// Pixel by pixel in scalars: most of the time is spent in the normal distribution's integral.
#include "range_histogram.h"
#include "range_histogram_math.h"

namespace GSPLAT_ISA::range_histogram {

using namespace gsplat::range_histogram;
using gsplat::kMinTransmittance;

namespace {

// Call visit(position, id, hit, depth, weight, transmittance) for the splats blended at a pixel, front to back.
template <class Visit>
inline __attribute__((always_inline)) void blend(const Inputs& in, const Tile& tile, int x, int y, const Visit& visit) {
  const float factor = factor_at(in, x, y);
  if (!(factor > 0)) return;
  float through = 1;
  for (int64_t position = tile.begin; position < tile.end; ++position) {
    const int64_t id = in.splats.splats.flatten_ids[position];
    const Hit hit = hit_of(in, id, float(x) + 0.5f, float(y) + 0.5f);
    if (hit.alpha == 0) continue;
    const float next = through - hit.alpha * through;
    if (!(next > kMinTransmittance)) return;
    visit(position, id, hit, depth_of(in, id, hit, factor), hit.alpha * through, through);
    through = next;
  }
}

void columns(const Inputs& in, int64_t tile_column, double* scratch, float* out) {
  const auto& splats = in.splats.splats;
  const int64_t first_x = tile_column * splats.tile_size;
  const int64_t stop = first_x + splats.tile_size < splats.width ? first_x + splats.tile_size : splats.width;
  if (stop <= first_x) return;
  for (int64_t i = 0; i < (stop - first_x) * in.bins; ++i) scratch[i] = 0;
  for (int64_t row = 0; row < splats.tile_height; ++row) {
    const Tile tile = tile_of(in, row * splats.tile_width + tile_column);
    for (int y = tile.y; y < tile.bottom; ++y)
      for (int x = tile.x; x < tile.right; ++x) {
        double* const bins = scratch + (x - first_x) * in.bins;
        blend(in, tile, x, y, [&](int64_t, int64_t, const Hit&, const Depth& d, float weight, float) {
          if (d.first >= d.end) return;
          const float inverse = 1 / d.spread;
          float below = normal_at((float(d.first) - d.at) * inverse).cdf;
          for (int b = d.first; b < d.end; ++b) {
            const float next = normal_at((float(b + 1) - d.at) * inverse).cdf;
            bins[b] += double(weight * (next - below));
            below = next;
          }
        });
      }
  }
  for (int64_t i = 0; i < (stop - first_x) * in.bins; ++i) out[first_x * in.bins + i] = float(scratch[i]);
}

void tile_backward(const Inputs& in, const float* gradient, int64_t index, float* rows) {
  const Tile tile = tile_of(in, index);
  for (int64_t i = tile.begin * kGradients; i < tile.end * kGradients; ++i) rows[i] = 0;
  for (int y = tile.y; y < tile.bottom; ++y)
    for (int x = tile.x; x < tile.right; ++x) {
      const float* const v = gradient + int64_t(x) * in.bins;
      float total = 0, before = 0;
      blend(in, tile, x, y, [&](int64_t, int64_t, const Hit&, const Depth& d, float weight, float) {
        total += weight * bin_gradients(d, v).value;
      });
      blend(in, tile, x, y, [&](int64_t position, int64_t id, const Hit& hit, const Depth& d, float weight, float through) {
        const BinGradients bins = bin_gradients(d, v);
        before += weight * bins.value;
        const float v_alpha = through * bins.value - (total - before) / (1 - hit.alpha);
        float own[kGradients];
        splat_gradients(in, id, hit, d, weight, bins, v_alpha, own);
        float* const row = rows + position * kGradients;
        for (int k = 0; k < kGradients; ++k) row[k] += own[k];
      });
    }
}

}  // namespace

extern const Kernels kernels = {columns, tile_backward};

}  // namespace GSPLAT_ISA::range_histogram
