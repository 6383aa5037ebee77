#include "weighted_sum.h"

#include "simd.h"
#include "transposed_rows.h"
#include "weighted_sum_math.h"

namespace GSPLAT_ISA::weighted_sum {

using namespace gsplat::weighted_sum;
using gsplat::kTileSize;

namespace {

typedef double vdouble __attribute__((vector_size(kLanes * 8)));
typedef int64_t vlong __attribute__((vector_size(kLanes * 8)));

constexpr int kVectors = (kTileSize + kLanes - 1) / kLanes;  // per row of a tile

GSPLAT_INLINE float limited(float c) { return c > kMostChannel ? kMostChannel : c < -kMostChannel ? -kMostChannel : c; }

void records(const Inputs& in, int64_t begin, int64_t end, SplatRecord* to) {
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    vfloat mean[2], conic[3], opacity, weight;
    load_rows<2>(in.means2d, first, count, mean);
    load_rows<3>(in.conics, first, count, conic);
    load_rows<1>(in.opacities, first, count, &opacity);
    load_rows<1>(in.weights, first, count, &weight);
    const Contour r = contour_of(mean, conic, opacity, weight);
    for (int i = 0; i < count; ++i) {
      bool finite = true;
      const float* const c = in.channels + (first + i) * in.channel_count;
      for (int k = 0; k < in.channel_count; ++k) finite &= c[k] - c[k] == 0;
      to[first + i] = {mean[0][i],
                       mean[1][i],
                       r.a[i],
                       r.b[i],
                       r.c[i],
                       r.l[i],
                       r.threshold[i],
                       finite ? r.half_width[i] : -1.0f,
                       finite ? r.half_height[i] : -1.0f,
                       r.sign[i]};
    }
  }
}

// |o| G of one splat in a row of pixels, 0 where it is below the threshold.
struct Row {
  vfloat dx, size;
  vmask reached;
};
GSPLAT_INLINE Row row_of(const SplatRecord& r, float dy, vfloat x) {
  Row row;
  row.dx = x - r.x;
  const vfloat across = fma(row.dx, splat(r.a), splat(r.b * dy));
  const vfloat power = fma(across, row.dx, splat(r.c * dy * dy + r.l));
  row.reached = at_least(power, splat(r.threshold));
  row.size = zero_unless(row.reached, exp2(smaller(power, splat(r.l))));
  return row;
}

// D is the number of channels, or 0 for any number.
template <int D>
void sum_tile(const Inputs& in, const SplatRecord* splats, int64_t tile, float* sums) {
  const int channels = D > 0 ? D : in.channel_count;
  const int x0 = int(tile % in.tile_width) * kTileSize, y0 = int(tile / in.tile_width) * kTileSize;
  const int right = x0 + kTileSize < in.width ? x0 + kTileSize : in.width;
  const int bottom = y0 + kTileSize < in.height ? y0 + kTileSize : in.height;
  alignas(64) int64_t added[((D > 0 ? D : kMostChannels) + 1)][kTileSize][kVectors * kLanes];
  for (int k = 0; k <= channels; ++k)
    for (int y = 0; y < kTileSize; ++y)
      for (int x = 0; x < kVectors * kLanes; ++x) added[k][y][x] = 0;
  const int64_t tiles = int64_t(in.tile_width) * in.tile_height;
  const int64_t end = tile + 1 < tiles ? in.offsets[tile + 1] : in.instances;
  for (int64_t at = in.offsets[tile]; at < end; ++at) {
    const int64_t i = in.flatten_ids[at];
    const SplatRecord& r = splats[i];
    if (r.half_height < 0) continue;
    const Range rows = range_of(r.y, r.half_height, y0, bottom);
    if (rows.last < rows.first) continue;
    double factors[(D > 0 ? D : kMostChannels) + 1];
    for (int k = 0; k < channels; ++k) factors[k] = double(limited(in.channels[i * channels + k])) * kScale;
    factors[channels] = kScale;
    const vfloat weight = splat(in.weights[i] * r.sign);
    for (int y = rows.first; y <= rows.last; ++y)
      for (int v = 0; v < kVectors; ++v) {
        const Row row = row_of(r, float(y) + 0.5f - r.y, ramp() + (float(x0 + v * kLanes) + 0.5f));
        if (lanes_of(row.reached) == 0) continue;
        const vfloat term = larger(smaller(row.size * weight, splat(kMostTerm)), splat(-kMostTerm));
        const vdouble wide = __builtin_convertvector(term, vdouble);
        for (int k = 0; k <= channels; ++k) {
          vlong sum;
          int64_t* const to = &added[k][y - y0][v * kLanes];
          __builtin_memcpy(&sum, to, sizeof(sum));
          sum += (vlong)(wide * factors[k] + kMagic) - kMagicBits;
          __builtin_memcpy(to, &sum, sizeof(sum));
        }
      }
  }
  const int64_t pixels = int64_t(in.width) * in.height;
  for (int k = 0; k <= channels; ++k)
    for (int y = y0; y < bottom; ++y)
      for (int x = x0; x < right; ++x)
        sums[k * pixels + int64_t(y) * in.width + x] = float(added[k][y - y0][x - x0]) * kInverseScale;
}

void tile(const Inputs& in, const SplatRecord* splats, int64_t at, float* sums) {
  switch (in.channel_count) {
    case 3: return sum_tile<3>(in, splats, at, sums);
    case 4: return sum_tile<4>(in, splats, at, sums);
    default: return sum_tile<0>(in, splats, at, sums);
  }
}

GSPLAT_INLINE vfloat load_first(const float* p, int count) {
  if (count == kLanes) return load(p);
  float values[kLanes] = {};
  for (int i = 0; i < count; ++i) values[i] = p[i];
  return load(values);
}

// Gradients of one splat: the sums over its pixels in rows from top to bottom, lane by lane.
template <int D>
void splat_backward(const Inputs& in, const SplatRecord& r, const float* v_sums, int64_t i, const InputGradients& out) {
  const int channels = D > 0 ? D : in.channel_count;
  const int64_t pixels = int64_t(in.width) * in.height;
  const float weight = in.weights[i];
  vfloat moments[kMoments] = {}, by_channel[D > 0 ? D : kMostChannels];
  float own[D > 0 ? D : kMostChannels];
  for (int k = 0; k < channels; ++k) {
    by_channel[k] = vfloat{};
    own[k] = limited(in.channels[i * channels + k]);
  }
  if (r.half_height >= 0) {
    const Range rows = range_of(r.y, r.half_height, 0, in.height), columns = range_of(r.x, r.half_width, 0, in.width);
    for (int y = rows.first; y <= rows.last; ++y) {
      const float dy = float(y) + 0.5f - r.y;
      for (int x = columns.first; x <= columns.last; x += kLanes) {
        const int count = columns.last - x + 1 < kLanes ? columns.last - x + 1 : kLanes;
        const Row row = row_of(r, dy, ramp() + (float(x) + 0.5f));
        if (lanes_of(row.reached) == 0) continue;
        const float* const v = v_sums + int64_t(y) * in.width + x;
        const vfloat alpha = row.size * r.sign, term = alpha * weight;
        const vmask counts = row.reached & above(splat(kMostTerm), larger(term, -term)) & above(splat(float(count)), ramp());
        const vfloat free = zero_unless(counts, alpha);
        vfloat gradient = load_first(v + channels * pixels, count);
        for (int k = 0; k < channels; ++k) {
          const vfloat v_channel = load_first(v + k * pixels, count);
          gradient = fma(v_channel, splat(own[k]), gradient);
          by_channel[k] = fma(v_channel, free, by_channel[k]);
        }
        const vfloat s = free * gradient, sx = s * row.dx, sy = s * dy;
        moments[0] += s;
        moments[1] += sx;
        moments[2] += sy;
        moments[3] += sx * row.dx;
        moments[4] += sx * dy;
        moments[5] += sy * dy;
      }
    }
  }
  float m[kMoments];
  for (int k = 0; k < kMoments; ++k) m[k] = sum(moments[k]);
  const float* const conic = in.conics + 3 * i;
  const bool reaches = r.half_height >= 0;
  out.means2d[2 * i] = reaches ? weight * (conic[0] * m[1] + conic[1] * m[2]) : 0;
  out.means2d[2 * i + 1] = reaches ? weight * (conic[1] * m[1] + conic[2] * m[2]) : 0;
  out.conics[3 * i] = reaches ? -0.5f * weight * m[3] : 0;
  out.conics[3 * i + 1] = reaches ? -weight * m[4] : 0;
  out.conics[3 * i + 2] = reaches ? -0.5f * weight * m[5] : 0;
  out.opacities[i] = reaches ? weight * m[0] / in.opacities[i] : 0;
  out.weights[i] = m[0];
  for (int k = 0; k < channels; ++k) {
    const bool is_free = reaches && own[k] == in.channels[i * channels + k];
    out.channels[i * channels + k] = is_free ? weight * sum(by_channel[k]) : 0;
  }
}

void backward(const Inputs& in, const SplatRecord* splats, const float* v_sums, int64_t begin, int64_t end,
              const InputGradients& out) {
  for (int64_t i = begin; i < end; ++i) switch (in.channel_count) {
      case 3: splat_backward<3>(in, splats[i], v_sums, i, out); break;
      case 4: splat_backward<4>(in, splats[i], v_sums, i, out); break;
      default: splat_backward<0>(in, splats[i], v_sums, i, out);
    }
}

}  // namespace

extern const gsplat::weighted_sum::Kernels kernels = {records, tile, backward};

}  // namespace GSPLAT_ISA::weighted_sum
