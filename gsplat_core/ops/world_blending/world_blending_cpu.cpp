#include "transposed_rows.h"
#include "world_blending.h"
#include "world_blending_math.h"

namespace GSPLAT_ISA::world_blending {

static void tile(const Inputs& in, int64_t tile, const Pixels& out, float* scratch) {
  const int64_t tiles = int64_t(in.tile_width) * in.tile_height, image = tile / tiles, place = tile % tiles;
  const bool masked = in.masks != nullptr && !in.masks[tile];
  const int64_t begin = masked ? 0 : in.offsets[tile];
  const int64_t end = masked ? 0 : tile + 1 < tiles * in.images ? in.offsets[tile + 1] : in.instances;
  const int left = int(place % in.tile_width) * in.tile_size, top = int(place / in.tile_width) * in.tile_size;
  const int right = left + in.tile_size < in.width ? left + in.tile_size : in.width;
  const int bottom = top + in.tile_size < in.height ? top + in.tile_size : in.height;
  const int channels = in.channels;
  const float* const gaussians = in.gaussians + image / in.cameras * in.count * kGaussianNumbers;
  for (int y = top; y < bottom; ++y)
    for (int x = left; x < right; x += kLanes) {
      const int count = right - x < kLanes ? right - x : kLanes;
      const int64_t pixel = (image * in.height + y) * in.width + x;
      vfloat ray[kRayNumbers], check = vfloat{};
      load_rows<kRayNumbers>(in.rays, pixel, count, ray);
      for (int k = 0; k < kRayNumbers; ++k) check += 0.0f * ray[k];
      vint open = (check == 0.0f) & (ramp() < float(count));
      vfloat through = splat(1.0f);
      for (int i = 0; i < channels * kLanes; ++i) scratch[i] = 0;
      for (int64_t i = begin; i < end && bits(open) != 0; ++i) {
        const int64_t id = in.flatten_ids[i];
        const vfloat squared = squared_distance(gaussians + id % in.count * kGaussianNumbers, ray);
        const vfloat alpha = min(in.opacities[id] * exp2(max(-kHalfLog2E * squared, splat(-126.0f))), splat(in.max_alpha));
        const vint hit = open & (alpha >= gsplat::kAlphaCutoff);
        if (bits(hit) == 0) continue;
        const vfloat next = through * (1 - alpha);
        const vint ends = hit & ~(next > gsplat::kMinTransmittance);
        open &= ~ends;
        const vint shown = hit & open;
        const vfloat weight = select(shown, alpha * through, vfloat{});
        const float* const color = in.colors + id * channels;
        for (int d = 0; d < channels; ++d) store(scratch + d * kLanes, load(scratch + d * kLanes) + weight * color[d]);
        through = select(shown, next, through);
      }
      store_rows<1>(out.through, pixel, count, &through);
      for (int j = 0; j < count; ++j)
        for (int d = 0; d < channels; ++d) out.colors[(pixel + j) * channels + d] = scratch[d * kLanes + j];
    }
}

extern const Kernels kernels = {tile};

}  // namespace GSPLAT_ISA::world_blending
