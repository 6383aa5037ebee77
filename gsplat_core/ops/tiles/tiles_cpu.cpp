// Exact intersection test of an ellipse and the tiles, and the two passes of the counting sort.
//
// A splat reaches the pixels where o exp(-sigma) >= 1/255: an ellipse. Its part within a row of tiles is convex, so it
// touches a contiguous run of tiles, given by its extent in x over the row's pixel centres. Tight extents follow
// StopThePop (Radl et al. 2024) and AccuTile; the extent within a strip is derived below.
#include "simd.h"
#include "tiles.h"

namespace GSPLAT_ISA::tiles {

using namespace gsplat::tiles;

namespace {

// Ellipses of one splat per lane: a dx^2 + 2 b dx dy + c dy^2 = k around (x, y), solved for dx: slope dy +- sqrt(offset
// - curve dy^2).
struct Ellipses {
  vfloat x, y;
  vfloat slope, offset, curve;
  vfloat top;    // dy of the rightmost point; the leftmost is at -top
  vmask proper;  // if false, the conic is not a proper ellipse in float32, and only the box is used
};

struct Conics {
  vfloat a, b, c;
};

GSPLAT_INLINE Ellipses make_ellipses(vfloat x, vfloat y, Conics q, vfloat k) {
  const vfloat zero = {}, ac = q.a * q.c;
  // The margin makes rounding errors of the determinant only widen the ellipse.
  const vfloat det = fma(-q.b, q.b, ac) - 5e-7f * ac, inverse = 1.0f / q.a;
  const vfloat top = -q.b * sqrt(k / (q.c * det));
  const vmask proper = above(q.a, zero) & above(q.c, zero) & above(det, 1e-6f * ac) & at_least(splat(1e30f), larger(top, -top));
  return {x, y, -q.b * inverse, k * inverse, det * inverse * inverse, top, proper};
}

// The columns [first, end) of a row of tiles, for one splat per lane.
struct Runs {
  vint first, end;
};

// Return the tiles that the ellipses touch in row `row` of their boxes, whose columns are box_first to box_end.
GSPLAT_INLINE Runs runs_of(const Ellipses& e, vfloat row, float tile_size, vfloat box_first, vfloat box_end) {
  const vfloat zero = {}, low = fma(row, splat(tile_size), 0.5f - e.y), high = low + (tile_size - 1);
  const vfloat at_right = smaller(larger(e.top, low), high), at_left = smaller(larger(-e.top, low), high);
  const vfloat right_square = fma(-e.curve * at_right, at_right, e.offset),
               left_square = fma(-e.curve * at_left, at_left, e.offset);
  constexpr float kSlack = 2e-3f;  // pixels, tolerance for rounding
  const vfloat right = fma(e.slope, at_right, e.x) + sqrt(larger(right_square, zero)) + kSlack;
  const vfloat left = fma(e.slope, at_left, e.x) - sqrt(larger(left_square, zero)) - kSlack;
  // Tile t contains the pixel centres t size + 0.5 ... t size + size - 0.5. The gap between the centres of two adjacent
  // tiles belongs to neither.
  const vfloat inverse = splat(1.0f / tile_size);
  const vfloat first = truncate(smaller(larger((left + 0.5f) * inverse, box_first), box_end));
  const vfloat past = first + where(above(left, fma(first + 1.0f, splat(tile_size), splat(-0.5f))), splat(1.0f), zero);
  const vfloat end = truncate(smaller(larger((right - 0.5f) * inverse + 1.0f, box_first), box_end));
  const vmask inside = at_least(smaller(right_square, left_square), zero);
  const vfloat from = where(e.proper, past, box_first), to = where(e.proper, where(inside, end, zero), box_end);
  return {to_int(from), to_int(to)};
}

// Return k of the contour sigma = k / 2 slightly outside of alpha = 1/255; negative if the splat reaches no pixel.
GSPLAT_INLINE vfloat contours(vfloat opacity) {
  const vfloat k = fma(log2(opacity * 255.0f), splat(1.3862944f), splat(1e-3f));  // 2 ln(255 o)
  return where(above(opacity, vfloat{}) & at_least(splat(3e38f), opacity), k, splat(-1.0f));
}

GSPLAT_INLINE vmask finite(vfloat v) { return at_least(splat(3.4028235e38f), larger(v, -v)) & at_least(v, v); }

// Prefetch the span of a later splat: splats in depth order are scattered in memory.
GSPLAT_INLINE void prefetch_span(const TileSpan* spans, const uint32_t* order, int64_t i, int64_t end) {
  constexpr int64_t kAhead = 16;
  if (i + kAhead < end) __builtin_prefetch(spans + order[i + kAhead]);
}

// Return the index of the first tile counter of this splat's image.
GSPLAT_INLINE int64_t first_tile(const SplatBoxes& in, int64_t splat) {
  const int64_t image = in.image_ids != nullptr ? in.image_ids[splat] : splat < in.per_image ? 0 : splat / in.per_image;
  return image * in.tile_width * in.tile_height;
}

// Call visit(tile) for every touched tile, row by row.
template <class Visit>
GSPLAT_INLINE void for_tiles(const SplatBoxes& in, int64_t id, const TileSpan& span, const Visit& visit) {
  const int64_t origin = int64_t(span.y) * in.tile_width + span.x;
  if (span.width <= 8 && span.height <= 8) {
    for (uint64_t left = span.touched; left != 0; left &= left - 1) {
      const int bit = __builtin_ctzll(left);
      visit(origin + int64_t(bit >> 3) * in.tile_width + (bit & 7));
    }
    return;
  }
  const float* const mean = in.means2d + 2 * id;
  const float none[3] = {}, *const q = in.conics != nullptr ? in.conics + 3 * id : none;
  const vfloat k = contours(splat(in.conics != nullptr ? in.opacities[id] : 1.0f));
  const Ellipses e = make_ellipses(splat(mean[0]), splat(mean[1]), {splat(q[0]), splat(q[1]), splat(q[2])}, k);
  for (int row = 0; row < span.height; row += kLanes) {
    const vfloat rows = ramp() + float(span.y + row);
    const Runs runs = runs_of(e, rows, float(in.tile_size), splat(float(span.x)), splat(float(span.x + span.width)));
    for (int i = 0; i < kLanes && row + i < span.height; ++i) {
      const int64_t start = int64_t(span.y + row + i) * in.tile_width;
      for (int column = runs.first[i]; column < runs.end[i]; ++column) visit(start + column);
    }
  }
}

void spans(const SplatBoxes& in, int64_t begin, int64_t end, TileSpan* spans, int32_t* tile_counts) {
  const vfloat zero = {}, size = splat(float(in.tile_size));
  const vfloat width = splat(float(in.tile_width)), height = splat(float(in.tile_height));
  for (int64_t first = begin; first < end; first += kLanes) {
    const int n = end - first < kLanes ? int(end - first) : kLanes;
    alignas(64) float fields[9][kLanes] = {};  // unused lanes have radii of 0
    for (int i = 0; i < n; ++i) {
      const int64_t at = first + i;
      fields[0][i] = in.means2d[2 * at];
      fields[1][i] = in.means2d[2 * at + 1];
      fields[2][i] = float(in.radii[2 * at]);
      fields[3][i] = float(in.radii[2 * at + 1]);
      fields[4][i] = in.depths[at];
      if (in.conics == nullptr) continue;
      for (int j = 0; j < 3; ++j) fields[5 + j][i] = in.conics[3 * at + j];
      fields[8][i] = in.opacities[at];
    }
    const vfloat x = load(fields[0]), y = load(fields[1]), rx = load(fields[2]), ry = load(fields[3]);
    vmask visible = above(rx, zero) & above(ry, zero) & finite(x) & finite(y) & finite(load(fields[4]));
    // gsplat's box: floor and ceil of (mean -+ radius) / tile size, clamped to the image.
    const vfloat x0 = truncate(smaller(larger((x - rx) / size, zero), width)),
                 y0 = truncate(smaller(larger((y - ry) / size, zero), height));
    const vfloat x1 = ceiling(smaller(larger((x + rx) / size, zero), width)),
                 y1 = ceiling(smaller(larger((y + ry) / size, zero), height));
    visible = visible & above(x1, x0) & above(y1, y0);
    Ellipses e = {};
    if (in.conics != nullptr) {
      const Conics q = {load(fields[5]), load(fields[6]), load(fields[7])};
      const vfloat k = contours(load(fields[8]));
      visible = visible & at_least(k, zero) & finite(q.a) & finite(q.b) & finite(q.c);
      e = make_ellipses(x, y, q, k);
    }
    const vint left = to_int(x0), one = splat_int(1), none = {};
    const vfloat rows = where(visible, y1 - y0, zero), columns = where(visible, x1 - x0, zero);
    alignas(64) int32_t box[4][kLanes];
    const vint edges[4] = {left, to_int(y0), to_int(columns), to_int(rows)};
    __builtin_memcpy(box, edges, sizeof(box));
    vint touched[2] = {};  // rows 0-3 and 4-7
    for (int row = 0; row < 8 && lanes_of(above(rows, splat(float(row)))) != 0; ++row) {
      const Runs runs = runs_of(e, y0 + float(row), float(in.tile_size), x0, x1);
      const vint run_bits = (one << (runs.end - left)) - (one << (runs.first - left));
      const vmask any = above(rows, splat(float(row))) & ~at_least(runs.first, runs.end);
      touched[row / 4] |= where(vmask(any), run_bits, none) << (8 * (row % 4));
    }
    alignas(64) uint32_t set[2][kLanes];
    __builtin_memcpy(set, touched, sizeof(set));
    for (int i = 0; i < n; ++i) {
      const bool small = box[2][i] <= 8 && box[3][i] <= 8;
      TileSpan span = {uint16_t(box[0][i]), uint16_t(box[1][i]), uint16_t(box[2][i]), uint16_t(box[3][i]), 0};
      int64_t tiles = 0;
      if (small) {
        span.touched = set[0][i] | uint64_t(set[1][i]) << 32;
        tiles = __builtin_popcountll(span.touched);
      } else {
        for_tiles(in, first + i, span, [&](int64_t) { ++tiles; });
      }
      spans[first + i] = span;
      tile_counts[first + i] = int32_t(tiles);
    }
  }
}

void count(const SplatBoxes& in, const TileSpan* spans, const uint32_t* order, int64_t begin, int64_t end, int32_t* counters) {
  for (int64_t i = begin; i < end; ++i) {
    prefetch_span(spans, order, i, end);
    int32_t* const mine = counters + first_tile(in, order[i]);
    for_tiles(in, order[i], spans[order[i]], [&](int64_t tile) { ++mine[tile]; });
  }
}

// Number of bits for n values, as gsplat counts them: floor(log2(n)) + 1.
GSPLAT_INLINE int bits_for(int64_t n) { return 64 - __builtin_clzll(uint64_t(n)); }

struct Key {
  int64_t image, depth;
  Key(const SplatBoxes& in, int64_t splat) {
    const int64_t tiles = int64_t(in.tile_width) * in.tile_height;
    image = (first_tile(in, splat) / tiles) << (32 + bits_for(tiles));
    uint32_t bits;
    __builtin_memcpy(&bits, in.depths + splat, 4);
    depth = int64_t(bits);
  }
  int64_t of_tile(int64_t tile) const { return image | (tile << 32) | depth; }
};

void emit(const SplatBoxes& in, const TileSpan* spans, const uint32_t* order, int64_t begin, int64_t end, int32_t* cursors,
          int32_t* flatten_ids, int64_t* keys) {
  for (int64_t i = begin; i < end; ++i) {
    prefetch_span(spans, order, i, end);
    const int64_t splat = order[i];
    int32_t* const mine = cursors + first_tile(in, splat);
    if (keys == nullptr) {
      for_tiles(in, splat, spans[splat], [&](int64_t tile) { flatten_ids[mine[tile]++] = int32_t(splat); });
    } else {
      const Key key(in, splat);
      for_tiles(in, splat, spans[splat], [&](int64_t tile) {
        const int64_t at = mine[tile]++;
        flatten_ids[at] = int32_t(splat);
        keys[at] = key.of_tile(tile);
      });
    }
  }
}

void emit_one(const SplatBoxes& in, const TileSpan& span, int64_t splat, int64_t at, int32_t* flatten_ids, int64_t* keys) {
  const Key key(in, splat);
  for_tiles(in, splat, span, [&](int64_t tile) {
    flatten_ids[at] = int32_t(splat);
    keys[at++] = key.of_tile(tile);
  });
}

}  // namespace

extern const Kernels kernels = {spans, count, emit, emit_one};

}  // namespace GSPLAT_ISA::tiles
