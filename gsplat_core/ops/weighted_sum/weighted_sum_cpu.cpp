#include "weighted_sum.h"

#include "simd.h"
#include "transposed_rows.h"
#include "weighted_sum_math.h"

namespace GSPLAT_ISA::weighted_sum {

using namespace gsplat::weighted_sum;
using gsplat::kTileSize;

namespace {

// Half of a vector of floats, and the same number of doubles and integers.
typedef float hfloat __attribute__((vector_size(kLanes * 2)));
typedef double vdouble __attribute__((vector_size(kLanes * 4)));
typedef int64_t vlong __attribute__((vector_size(kLanes * 4)));

constexpr int kBatch = 64;                                   // splats per pass over a tile's rows
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

// A splat listed in a tile: its record, rows of the tile, and channels in units of the quantum.
template <int D>
struct Listed {
  SplatRecord record;
  float weight;  // with the sign of the opacity
  int first, last;
  double factors[D + 1];
};

// Add the terms of one row of pixels to `sums`, as integers: the bits of a double after adding kMagic. Each addition also
// adds kMagicBits, which is subtracted at the end.
template <int D>
GSPLAT_INLINE void add_terms(vfloat term, const double* factors, vlong (*sums)[2]) {
  for (int half = 0; half < 2; ++half) {
    hfloat part;
    __builtin_memcpy(&part, (const char*)&term + half * sizeof(part), sizeof(part));
    const vdouble wide = __builtin_convertvector(part, vdouble);
    for (int k = 0; k <= D; ++k) sums[k][half] += (vlong)(wide * factors[k] + kMagic);
  }
}

// Sum D channels from `first_channel` on, and the terms themselves if `total`.
template <int D>
void sum_tile(const Inputs& in, const SplatRecord* splats, int64_t tile, int first_channel, bool total, float* sums) {
  const int x0 = int(tile % in.tile_width) * kTileSize, y0 = int(tile / in.tile_width) * kTileSize;
  const int right = x0 + kTileSize < in.width ? x0 + kTileSize : in.width;
  const int bottom = y0 + kTileSize < in.height ? y0 + kTileSize : in.height;
  // Sums of the doubles' bits by row, vector of pixels, channel and half, and the number of terms in each.
  vlong added[kTileSize][kVectors][D + 1][2];
  int64_t terms[kTileSize][kVectors] = {};
  __builtin_memset(added, 0, sizeof(added));
  const int64_t tiles = int64_t(in.tile_width) * in.tile_height;
  const int64_t end = tile + 1 < tiles ? in.offsets[tile + 1] : in.instances;
  Listed<D> listed[kBatch];
  for (int64_t at = in.offsets[tile]; at < end;) {
    int count = 0;
    for (; at < end && count < kBatch; ++at) {
      const int64_t i = in.flatten_ids[at];
      const SplatRecord& r = splats[i];
      if (r.half_height < 0) continue;
      const Range rows = range_of(r.y, r.half_height, y0, bottom);
      if (rows.last < rows.first) continue;
      Listed<D>& to = listed[count++];
      to.record = r;
      to.weight = in.weights[i] * r.sign;
      to.first = rows.first;
      to.last = rows.last;
      const float* const channels = in.channels + i * in.channel_count + first_channel;
      for (int k = 0; k < D; ++k) to.factors[k] = double(limited(channels[k])) * kScale;
      to.factors[D] = kScale;
    }
    for (int y = y0; y < bottom; ++y)
      for (int v = 0; v < kVectors; ++v) {
        const vfloat x = ramp() + (float(x0 + v * kLanes) + 0.5f);
        vlong row_sums[D + 1][2];
        __builtin_memcpy(row_sums, added[y - y0][v], sizeof(row_sums));
        int64_t row_terms = 0;
        for (int j = 0; j < count; ++j) {
          const Listed<D>& from = listed[j];
          if (y < from.first || y > from.last) continue;
          const Row row = row_of(from.record, float(y) + 0.5f - from.record.y, x);
          if (lanes_of(row.reached) == 0) continue;
          const vfloat term = larger(smaller(row.size * from.weight, splat(kMostTerm)), splat(-kMostTerm));
          add_terms<D>(term, from.factors, row_sums);
          ++row_terms;
        }
        __builtin_memcpy(added[y - y0][v], row_sums, sizeof(row_sums));
        terms[y - y0][v] += row_terms;
      }
  }
  const int64_t pixels = int64_t(in.width) * in.height;
  for (int y = y0; y < bottom; ++y)
    for (int x = x0; x < right; ++x) {
      const int v = (x - x0) / kLanes, lane = (x - x0) % kLanes;
      const int64_t pixel = int64_t(y) * in.width + x;
      const uint64_t magic = uint64_t(terms[y - y0][v]) * uint64_t(kMagicBits);
      for (int k = 0; k < D + int(total); ++k) {
        const uint64_t bits = uint64_t(added[y - y0][v][k][lane / (kLanes / 2)][lane % (kLanes / 2)]);
        const int64_t plane = k < D ? first_channel + k : in.channel_count;
        sums[plane * pixels + pixel] = float(int64_t(bits - magic)) * kInverseScale;
      }
    }
}

void tile(const Inputs& in, const SplatRecord* splats, int64_t at, float* sums) {
  for (int first = 0; first < in.channel_count;) {
    const int left = in.channel_count - first;
    const bool total = first == 0;
    switch (left) {
      case 1: sum_tile<1>(in, splats, at, first, total, sums); break;
      case 2: sum_tile<2>(in, splats, at, first, total, sums); break;
      case 3: sum_tile<3>(in, splats, at, first, total, sums); break;
      default: sum_tile<4>(in, splats, at, first, total, sums);
    }
    first += left < 4 ? left : 4;
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
