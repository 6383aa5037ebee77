#include "../spherical_harmonics/spherical_harmonics_bases.h"
#include "simd.h"
#include "stochastic.h"
#include "stochastic_math.h"
#include "transposed_rows.h"

namespace GSPLAT_ISA::stochastic {

constexpr int kMaxBases = 25;

// exp(x), limited to 2^-126 ... 2^126.
GSPLAT_INLINE vfloat exponential(vfloat x) {
  const vfloat power = min(max(x * kLog2e, splat(-126.0f)), splat(126.0f));
  return select(x == x, exp2(power), x);
}

GSPLAT_INLINE Loaded load(const Scene& scene, int64_t first, int count) {
  Loaded one;
  vfloat quat[4], log_scales[3];
  if (scene.packed != nullptr) {
    float columns[11][kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      const Decoded d = decode(scene, first + (lane < count ? lane : count - 1));
      for (int k = 0; k < 3; ++k) columns[k][lane] = d.mean[k];
      for (int k = 0; k < 4; ++k) columns[3 + k][lane] = d.quat[k];
      for (int k = 0; k < 3; ++k) columns[7 + k][lane] = d.log_scales[k];
      columns[10][lane] = d.opacity;
    }
    for (int k = 0; k < 3; ++k) one.mean[k] = GSPLAT_ISA::load(columns[k]);
    for (int k = 0; k < 4; ++k) quat[k] = GSPLAT_ISA::load(columns[3 + k]);
    for (int k = 0; k < 3; ++k) log_scales[k] = GSPLAT_ISA::load(columns[7 + k]);
    one.opacity = GSPLAT_ISA::load(columns[10]);
  } else {
    load_rows<3>(scene.means, first, count, one.mean);
    if (scene.covars != nullptr) {
      Symmetric3 sigma;
      load_rows<6>(scene.covars, first, count, sigma.v);
      load_rows<1>(scene.opacities, first, count, &one.opacity);
      one.geometry = geometry_of(sigma);
      return one;
    }
    load_rows<4>(scene.quats, first, count, quat);
    load_rows<3>(scene.log_scales, first, count, log_scales);
    load_rows<1>(scene.logits, first, count, &one.opacity);
    one.opacity = 1.0f / (1.0f + exponential(-one.opacity));
  }
  vfloat scales[3];
  for (int k = 0; k < 3; ++k) scales[k] = exponential(log_scales[k]);
  one.geometry = geometry_of(quat, scales);
  return one;
}

static int64_t project_rows(const Scene& scene, const Request& view, int64_t begin, int64_t end, Splat* out) {
  const ProjectionInput in = projection_input(view);
  int64_t written = 0;
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    const Loaded one = load(scene, first, count);
    const Projected p = project(in, one.mean, one.geometry, &one.opacity, false);
    const uint32_t visible = bits(p.valid) & ((1u << count) - 1);
    if (visible == 0) continue;
    Plane plane = {};
    if (view.pixel_order) plane = plane_of(in, one, scene.covars == nullptr);
    for (uint32_t rest = visible; rest != 0; rest &= rest - 1) {
      const int i = __builtin_ctz(rest);
      const Lane lane = {p.u[i],
                         p.v[i],
                         p.depth[i],
                         {p.conic[0][i], p.conic[1][i], p.conic[2][i]},
                         {p.half_x[i], p.half_y[i]},
                         p.determinant[i],
                         one.opacity[i],
                         {plane.coefficients[0][i], plane.coefficients[1][i], plane.coefficients[2][i]},
                         plane.reach[i]};
      const int64_t row = first + i;
      const uint32_t key = scene.index != nullptr ? uint32_t(scene.index[row]) : uint32_t(row);
      if (finish_splat(view, lane, uint32_t(row), key, out[written])) ++written;
    }
  }
  return written;
}

GSPLAT_INLINE void lower(uint64_t* place, uint64_t word) {
  uint64_t seen = __atomic_load_n(place, __ATOMIC_RELAXED);
  while (word < seen && !__atomic_compare_exchange_n(place, &seen, word, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
  }
}

// Draw the fragments `from` to `to` - 1 of a splat's box.
GSPLAT_INLINE void draw_fragments(const Request& view, const Splat& s, int64_t from, int64_t to, uint64_t* frame) {
  const int32_t columns = int32_t(s.size & 0xffff) + 1, column0 = int32_t(s.corner & 0xffff), row0 = int32_t(s.corner >> 16);
  const float inverse = 1.0f / float(view.supersampling);
  const vint lane = to_int(ramp());
  for (int32_t y = int32_t(from / columns); int64_t(y) * columns < to; ++y) {
    const int64_t row_start = int64_t(y) * columns;
    const int32_t begin = from > row_start ? int32_t(from - row_start) : 0;
    const int32_t end = to - row_start < columns ? int32_t(to - row_start) : columns;
    const int32_t row = row0 + y;
    const float py = (float(row) + 0.5f) * inverse, dy = py - s.v;
    for (int32_t x = begin; x < end; x += kLanes) {
      const vint column = lane + (column0 + x);
      const vfloat px = (__builtin_convertvector(column, vfloat) + 0.5f) * inverse, dx = px - s.u;
      const vfloat power = s.log2_opacity - (s.conic[0] * dx * dx + 2 * s.conic[1] * dx * dy + s.conic[2] * dy * dy);
      const vint covered = (power >= gsplat::kLog2AlphaCutoff) & (lane < end - x);
      if (bits(covered) == 0) continue;
      const vfloat alpha = min(exp2(max(power, splat(-30.0f))), splat(gsplat::kMaxAlpha));
      vfloat z = splat(s.z);
      if (view.pixel_order) {
        const vfloat t = 1.0f / (s.plane[0] * px + s.plane[1] * py + s.plane[2]);
        // A plane seen edge-on has no depth there (infinite, negative or NaN).
        const vfloat near = max(splat(s.z - s.extra), splat(kNearPlane));
        z = select(t > 0, max(min(t, splat(s.z + s.extra)), near), splat(s.z));
      }
      const int64_t first = int64_t(row) * view.columns() + column0 + x;
      vuint c[4] = {(vuint)lane + uint32_t(first), s.key - vuint{}, (view.sample / kMaxSlots) - vuint{},
                    uint32_t(kAlphaStream) - vuint{}};
      philox(c, view.seed[0], view.seed[1]);
      for (int slot = 0; slot < view.slots; ++slot) {
        if (!(view.active >> slot & 1)) continue;
        const vint hit = covered & (unit_interval(c[(view.sample + uint32_t(slot)) % kMaxSlots]) < alpha);
        for (uint32_t rest = bits(hit); rest != 0; rest &= rest - 1) {
          const int i = __builtin_ctz(rest);
          lower(frame + (first + i) * view.slots + slot, word_of(z[i], s.row));
        }
      }
    }
  }
}

static void draw(const Request& view, const Splat* splats, const int64_t* starts, int64_t count, int64_t begin, int64_t end,
                 uint64_t* frame) {
  int64_t low = 0, high = count;  // starts[low] <= begin < starts[high]
  while (high - low > 1) {
    const int64_t middle = (low + high) / 2;
    if (starts[middle] <= begin)
      low = middle;
    else
      high = middle;
  }
  for (int64_t i = low; i < count && starts[i] < end; ++i) {
    const Splat& s = splats[i];
    const int64_t from = begin > starts[i] ? begin - starts[i] : 0;
    const int64_t to = (end < starts[i + 1] ? end : starts[i + 1]) - starts[i];
    if (view.method == kFragments) {
      draw_fragments(view, s, from, to, frame);
    } else if (s.extra < 0) {
      const int32_t columns = int32_t(s.size & 0xffff) + 1, column0 = int32_t(s.corner & 0xffff), row0 = int32_t(s.corner >> 16);
      for (int64_t k = from; k < to; ++k) {
        const int32_t column = column0 + int32_t(k % columns), row = row0 + int32_t(k / columns);
        uint64_t* place = frame + int64_t(row) * view.columns() + column;
        const uint64_t word = word_of(s.z, s.row);
        if (word < __atomic_load_n(place, __ATOMIC_RELAXED) && has_point(view, s, column, row)) lower(place, word);
      }
    } else {
      for (int64_t k = from; k < to; ++k) {
        const int64_t place = point_of(view, s, uint32_t(k));
        if (place >= 0) lower(frame + place, word_of(s.z, s.row));
      }
    }
  }
}

// Add one sample of kLanes consecutive pixels, from the frame's words at frame[lane * step].
template <int degree>
GSPLAT_INLINE void add_colours(const Scene& scene, const float* centre, const uint64_t* frame, int64_t step, int count,
                               float* sums) {
  float directions[3][kLanes], bases[kMaxBases][kLanes];
  constexpr int used = (degree + 1) * (degree + 1);
  uint32_t rows[kLanes];
  bool any = false;
  for (int lane = 0; lane < kLanes; ++lane) {
    const uint64_t word = lane < count ? frame[lane * step] : kEmpty;
    rows[lane] = uint32_t(word);
    float mean[3] = {centre[0], centre[1], centre[2] + 1};
    if (word != kEmpty) {
      any = true;
      if (scene.packed != nullptr)
        decode_mean(scene, rows[lane], mean);
      else
        for (int k = 0; k < 3; ++k) mean[k] = scene.means[3 * int64_t(rows[lane]) + k];
    }
    for (int k = 0; k < 3; ++k) directions[k][lane] = mean[k] - centre[k];
  }
  if (!any) return;
  vfloat d[3], columns[kMaxBases];
  for (int k = 0; k < 3; ++k) d[k] = GSPLAT_ISA::load(directions[k]);
  const vfloat inverse_norm = 1.0f / sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
  spherical_harmonics::bases_at<degree>(d[0] * inverse_norm, d[1] * inverse_norm, d[2] * inverse_norm, columns);
  for (int k = 0; k < used; ++k) store(bases[k], columns[k]);
  for (int lane = 0; lane < count; ++lane) {
    const uint64_t word = frame[lane * step];
    if (word == kEmpty) continue;
    float decoded[3 * kMaxBases], colour[3] = {};
    const float* sh = decoded;
    if (scene.packed != nullptr)
      decode_sh(scene, rows[lane], decoded);
    else
      sh = scene.sh + int64_t(rows[lane]) * scene.bases * 3;
    for (int n = 0; n < used; ++n)
      for (int k = 0; k < 3; ++k) colour[k] += bases[n][lane] * sh[3 * n + k];
    float* sum = sums + 5 * lane;
    for (int k = 0; k < 3; ++k) sum[k] += colour[k] + 0.5f > 0 ? colour[k] + 0.5f : 0;
    sum[3] += 1;
    float z;
    const uint32_t depth = uint32_t(word >> 32);
    __builtin_memcpy(&z, &depth, sizeof(z));
    sum[4] += z;
  }
}

template <int degree>
static void resolve_degree(const Scene& scene, const Request& view, const uint64_t* frame, float* sums, int64_t begin,
                           int64_t end) {
  float centre[3];
  for (int i = 0; i < 3; ++i) {
    centre[i] = 0;
    for (int k = 0; k < 3; ++k) centre[i] -= view.viewmat[4 * k + i] * view.viewmat[4 * k + 3];
  }
  const int64_t step = int64_t(view.supersampling) * view.slots;
  for (int64_t row = begin; row < end; ++row)
    for (int32_t x = 0; x < view.width; x += kLanes) {
      const int count = view.width - x < kLanes ? view.width - x : kLanes;
      for (int sub = 0; sub < view.supersampling; ++sub) {
        const int64_t at = (row * view.supersampling + sub) * view.columns() + int64_t(x) * view.supersampling;
        for (int64_t slot = 0; slot < step; ++slot)
          if (view.active >> (slot % view.slots) & 1)
            add_colours<degree>(scene, centre, frame + at * view.slots + slot, step, count, sums + 5 * (row * view.width + x));
      }
    }
}

static void resolve(const Scene& scene, const Request& view, const uint64_t* frame, float* sums, int64_t begin, int64_t end) {
  switch (scene.degree) {
    case 0: return resolve_degree<0>(scene, view, frame, sums, begin, end);
    case 1: return resolve_degree<1>(scene, view, frame, sums, begin, end);
    case 2: return resolve_degree<2>(scene, view, frame, sums, begin, end);
    case 3: return resolve_degree<3>(scene, view, frame, sums, begin, end);
    default: return resolve_degree<4>(scene, view, frame, sums, begin, end);
  }
}

static void draw_poisson(const double* rates, int64_t rate_count, int64_t count, uint64_t seed, int64_t* out) {
  const uint32_t words[2] = {uint32_t(seed), uint32_t(seed >> 32)};
  for (int64_t r = 0; r < rate_count; ++r)
    for (int64_t k = 0; k < count; ++k) out[r * count + k] = poisson(rates[r], uint32_t(r), uint32_t(k), words);
}

extern const gsplat::stochastic::Kernels kernels = {project_rows, draw, resolve, draw_poisson};

}  // namespace GSPLAT_ISA::stochastic
