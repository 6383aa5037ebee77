// Front-to-back blending along rays and its gradient, traversed back to front from the saved transmittance.
//
// With w_i the weight of Gaussian i and g_i = dL/dw_i, dL/dalpha_i = T_i g_i - (sum of w_j g_j behind i + T dL/dT) / (1 -
// alpha_i), T_i being the transmittance in front of i and T the remaining one.
#include "transposed_rows.h"
#include "world_blending.h"
#include "world_blending_math.h"

namespace GSPLAT_ISA::world_blending {

// Pixels and list of a tile.
struct Tile {
  int64_t image, begin, end;
  int left, top, right, bottom;
};
static Tile tile_of(const Inputs& in, int64_t index) {
  const int64_t tiles = int64_t(in.tile_width) * in.tile_height, place = index % tiles;
  const int left = int(place % in.tile_width) * in.tile_size, top = int(place / in.tile_width) * in.tile_size;
  return {index / tiles,
          in.offsets[index],
          index + 1 < tiles * in.images ? in.offsets[index + 1] : in.instances,
          left,
          top,
          left + in.tile_size < in.width ? left + in.tile_size : in.width,
          top + in.tile_size < in.height ? top + in.tile_size : in.height};
}

GSPLAT_INLINE const float* gaussian_of(const Inputs& in, int64_t image, int64_t id) {
  return in.gaussians + (image / in.cameras * in.count + id % in.count) * kGaussianNumbers;
}

GSPLAT_INLINE vfloat alpha_of(float opacity, const Passing& p) { return opacity * exp2(log2_response(p.squared)); }

static void tile(const Inputs& in, int64_t index, const Pixels& out, float* scratch) {
  const Tile t = tile_of(in, index);
  const int64_t begin = t.begin, end = in.masks != nullptr && !in.masks[index] ? begin : t.end;
  const int channels = in.channels;
  for (int y = t.top; y < t.bottom; ++y)
    for (int x = t.left; x < t.right; x += kLanes) {
      const int count = t.right - x < kLanes ? t.right - x : kLanes;
      const int64_t pixel = (t.image * in.height + y) * in.width + x;
      vfloat ray[kRayNumbers], check = vfloat{};
      load_rows<kRayNumbers>(in.rays, pixel, count, ray);
      for (int k = 0; k < kRayNumbers; ++k) check += 0.0f * ray[k];
      vint open = (check == 0.0f) & (ramp() < float(count)), last = splat_int(-1);
      vfloat through = splat(1.0f);
      for (int i = 0; i < channels * kLanes; ++i) scratch[i] = 0;
      for (int64_t i = begin; i < end && bits(open) != 0; ++i) {
        const int64_t id = in.flatten_ids[i];
        const vfloat alpha = min(alpha_of(in.opacities[id], passing(gaussian_of(in, t.image, id), ray)), splat(in.max_alpha));
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
        last = (shown & splat_int(int32_t(i))) | (~shown & last);
      }
      store_rows<1>(out.through, pixel, count, &through);
      for (int j = 0; j < count; ++j) {
        out.last[pixel + j] = last[j];
        for (int d = 0; d < channels; ++d) out.colors[(pixel + j) * channels + d] = scratch[d * kLanes + j];
      }
    }
}

// Columns of a window's pixels in scratch memory: pixel (x, y) of the window is number 16 y + x of each.
struct Columns {
  float *rays, *v_rays, *through, *behind, *v_colors, *color_sums;
  Columns(float* scratch, int channels) {
    constexpr int kPixels = kWindow * kWindow;
    rays = scratch, v_rays = rays + kRayNumbers * kPixels, through = v_rays + kRayNumbers * kPixels;
    behind = through + kPixels, v_colors = behind + kPixels, color_sums = v_colors + channels * kPixels;
  }
};

// Add the terms of a Gaussian at one vector of pixels from number `at` on to `sum` and `columns.color_sums`, and advance the
// pixels to in front of it.
GSPLAT_INLINE void add_terms(const Inputs& in, const float* gaussian, int64_t id, int32_t position, vint last, int at,
                             const Columns& columns, vfloat* sum) {
  constexpr int kPixels = kWindow * kWindow;
  vfloat ray[kRayNumbers], v_ray[kRayNumbers];
  for (int k = 0; k < kRayNumbers; ++k) ray[k] = load(columns.rays + k * kPixels + at);
  Passing p = passing(gaussian, ray);
  const vfloat unlimited = alpha_of(in.opacities[id], p), limit = splat(in.max_alpha);
  const vint hit = (min(unlimited, limit) >= gsplat::kAlphaCutoff) & (last >= position);
  if (bits(hit) == 0) return;
  const vfloat alpha = select(hit, min(unlimited, limit), vfloat{}), widen = 1 / (1 - alpha);
  const vfloat through = load(columns.through + at) * widen, behind = load(columns.behind + at), weight = alpha * through;
  const float* const color = in.colors + id * in.channels;
  vfloat g = vfloat{};
  for (int d = 0; d < in.channels; ++d) {
    const vfloat v = load(columns.v_colors + d * kPixels + at);
    float* const to = columns.color_sums + d * kLanes;
    g = fma(v, splat(color[d]), g);
    store(to, fma(weight, v, load(to)));
  }
  const vfloat v_alpha = fma(through, g, -(behind * widen));
  store(columns.through + at, through);
  store(columns.behind + at, fma(weight, g, behind));
  // Where alpha is clamped to its maximum, opacity and shape have no gradient. Elsewhere numbers may be infinite.
  const vint free = hit & (unlimited <= limit);
  for (int k = 0; k < 3; ++k) {
    p.apart[k] = select(free, p.apart[k], vfloat{});
    p.away[k] = select(free, p.away[k], vfloat{});
  }
  p.step = select(free, p.step, vfloat{});
  for (int k = 0; k < kRayNumbers; ++k) v_ray[k] = load(columns.v_rays + k * kPixels + at);
  add_moments(gaussian, p, ray, select(free, alpha * v_alpha, vfloat{}), sum, v_ray);
  for (int k = 0; k < kRayNumbers; ++k) store(columns.v_rays + k * kPixels + at, v_ray[k]);
}

// Compute the gradient rows of a tile's instances from the pixels of one window. With `add` they are added to the rows,
// otherwise they overwrite them.
static void window_backward(const Inputs& in, const Tile& t, int x0, int y0, bool add, const PixelGradients& from,
                            const GradientRows& out, float* scratch) {
  constexpr int kPixels = kWindow * kWindow;
  const int width = t.right - x0 < kWindow ? t.right - x0 : kWindow, height = t.bottom - y0 < kWindow ? t.bottom - y0 : kWindow;
  const int channels = in.channels;
  const Columns columns(scratch, channels);
  for (int64_t i = 0; i < backward_scratch(channels); ++i) scratch[i] = 0;
  int32_t last[kPixels], furthest = -1, furthest_of[kPixels / kLanes];
  for (int at = 0; at < kPixels; ++at) last[at] = -1;
  for (int block = 0; block < kPixels / kLanes; ++block) furthest_of[block] = -1;
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x) {
      const int at = y * kWindow + x;
      const int64_t pixel = (t.image * in.height + y0 + y) * in.width + x0 + x;
      last[at] = from.last[pixel];
      columns.through[at] = from.through[pixel];
      columns.behind[at] = from.through[pixel] * from.v_through[pixel];
      // A pixel without a ray (NaN, outside of the lens) has no Gaussian. It gets a ray of 0, because NaN would spread.
      for (int k = 0; k < kRayNumbers && last[at] >= 0; ++k) columns.rays[k * kPixels + at] = in.rays[pixel * kRayNumbers + k];
      for (int d = 0; d < channels; ++d) columns.v_colors[d * kPixels + at] = from.v_colors[pixel * channels + d];
      int32_t& most = furthest_of[at / kLanes];
      most = last[at] > most ? last[at] : most;
      furthest = most > furthest ? most : furthest;
    }
  for (int64_t position = t.end - 1; position >= t.begin; --position) {
    float* const to = out.rows + int64_t(out.row_of[position]) * out.row_size;
    if (!add)
      for (int r = 0; r < kMoments + channels; ++r) to[r] = 0;
    if (position > furthest) continue;
    const int64_t id = in.flatten_ids[position];
    const float* const gaussian = gaussian_of(in, t.image, id);
    vfloat total[kMoments] = {};
    for (int i = 0; i < channels * kLanes; ++i) columns.color_sums[i] = 0;
    for (int block = 0; block < height * kWindow / kLanes; ++block) {
      if (furthest_of[block] < position) continue;
      vint own_last;
      __builtin_memcpy(&own_last, last + block * kLanes, sizeof(own_last));
      add_terms(in, gaussian, id, int32_t(position), own_last, block * kLanes, columns, total);
    }
    for (int r = 0; r < kMoments; ++r) to[r] += sum(total[r]);
    for (int d = 0; d < channels; ++d) to[kMoments + d] += sum(load(columns.color_sums + d * kLanes));
  }
  for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
      for (int k = 0; k < kRayNumbers; ++k)
        out.rays[((t.image * in.height + y0 + y) * in.width + x0 + x) * kRayNumbers + k] =
            columns.v_rays[k * kPixels + y * kWindow + x];
}

static void tile_backward(const Inputs& in, int64_t index, const PixelGradients& from, const GradientRows& out, float* scratch) {
  const Tile t = tile_of(in, index);
  bool add = false;
  for (int y = t.top; y < t.bottom; y += kWindow)
    for (int x = t.left; x < t.right; x += kWindow, add = true) window_backward(in, t, x, y, add, from, out, scratch);
  if (add) return;  // else the tile is outside of the image, and its instances reach no pixel
  for (int64_t position = t.begin; position < t.end; ++position)
    for (int64_t r = 0; r < out.row_size; ++r) out.rows[out.row_of[position] * out.row_size + r] = 0;
}

static void gather(const Inputs& in, const GradientRows& from, const int32_t* first, int64_t begin, int64_t end,
                   const InputGradients& out) {
  const int channels = in.channels;
  for (int64_t i = begin; i < end; ++i) {
    float total[kMoments] = {};
    float* const v_color = out.colors + i * channels;
    for (int d = 0; d < channels; ++d) v_color[d] = 0;
    for (int64_t row = first[i]; row < first[i + 1]; ++row) {
      const float* const own = from.rows + row * from.row_size;
      for (int r = 0; r < kMoments; ++r) total[r] += own[r];
      for (int d = 0; d < channels; ++d) v_color[d] += own[kMoments + d];
    }
    gaussian_gradients(total, gaussian_of(in, i / in.count, i), in.opacities[i], out.gaussians + i * kGaussianNumbers,
                       out.opacities + i);
  }
}

extern const Kernels kernels = {tile, tile_backward, gather};

}  // namespace GSPLAT_ISA::world_blending
