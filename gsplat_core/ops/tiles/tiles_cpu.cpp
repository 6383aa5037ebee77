// The exact test of an ellipse against the tiles, and the two passes of the counting sort.
//
// A splat reaches the pixels where o exp(-sigma) >= 1/255: an ellipse. Its part inside a row of tiles is convex, so it touches a
// contiguous run of tiles, given by its extent in x over the row's pixel centres (Gaussian splat extents after StopThePop,
// Radl et al. 2024, and AccuTile; the extent in a strip is our own derivation, below).
#include "simd.h"
#include "tiles.h"

namespace GSPLAT_ISA {
namespace {

// a dx^2 + 2 b dx dy + c dy^2 = k around (x, y), solved for dx: slope dy +- sqrt(offset - curve dy^2).
struct Ellipse {
  float x, y;
  float slope, offset, curve;
  float top;  // dy of the rightmost point; the leftmost is at -top
};

struct Run {
  int first, end;
};

GSPLAT_INLINE int clamp_to(float v, int high) { return v >= float(high) ? high : v > 0 ? int(v) : 0; }
GSPLAT_INLINE float clamp_between(float v, float low, float high) { return v < low ? low : v > high ? high : v; }

// False where the conic is not a proper ellipse: then the box alone decides.
GSPLAT_INLINE bool make_ellipse(const SplatBoxes& in, int64_t splat, float k, Ellipse& e) {
  const float a = in.conics[3 * splat], b = in.conics[3 * splat + 1], c = in.conics[3 * splat + 2];
  // A determinant lost to rounding only widens the ellipse.
  const float ac = a * c, det = ac - b * b - 5e-7f * ac;
  if (!(a > 0 && c > 0 && ac > 0 && det > 1e-6f * ac)) return false;
  e.x = in.means2d[2 * splat];
  e.y = in.means2d[2 * splat + 1];
  e.slope = -b / a;
  e.offset = k / a;
  e.curve = det / (a * a);
  e.top = -b * __builtin_sqrtf(k / (c * det));
  return e.top - e.top == 0;
}

// Tiles of row `row` that the ellipse touches, inside [first, end).
GSPLAT_INLINE Run run_of_row(const Ellipse& e, int row, int tile_size, Run box) {
  const float low = float(int64_t(row) * tile_size) + 0.5f - e.y, high = low + float(tile_size - 1);
  const float at_right = clamp_between(e.top, low, high), at_left = clamp_between(-e.top, low, high);
  const float right_square = e.offset - e.curve * at_right * at_right, left_square = e.offset - e.curve * at_left * at_left;
  if (right_square < 0 || left_square < 0) return {0, 0};
  constexpr float kSlack = 2e-3f;  // pixels, against rounding
  const float right = e.x + e.slope * at_right + __builtin_sqrtf(right_square) + kSlack;
  const float left = e.x + e.slope * at_left - __builtin_sqrtf(left_square) - kSlack;
  const float inverse = 1.0f / float(tile_size);
  // Tile t holds the pixel centres t size + 0.5 ... t size + size - 0.5.
  const int first = clamp_to((left + 0.5f) * inverse, box.end);
  const int end = clamp_to((right - 0.5f) * inverse + 1.0f, box.end);
  // A gap between the last centre of one tile and the first of the next is in neither.
  const int skip = left > float((int64_t(first) + 1) * tile_size) - 0.5f ? 1 : 0;
  return {first + skip > box.first ? first + skip : box.first, end};
}

GSPLAT_INLINE bool finite(float v) { return v - v == 0; }

// The contour: sigma <= k / 2, a little outside of alpha = 1/255.
GSPLAT_INLINE float contour(float opacity) { return opacity > 0 ? 1.3862944f * log2(splat(255.0f * opacity))[0] + 1e-3f : -1.0f; }

TileSpan span_of(const SplatBoxes& in, int64_t splat, float k) {
  const TileSpan nothing = {0, 0, 0, 0, 0};
  const int rx = in.radii[2 * splat], ry = in.radii[2 * splat + 1];
  const float x = in.means2d[2 * splat], y = in.means2d[2 * splat + 1];
  if (rx <= 0 || ry <= 0 || !finite(x) || !finite(y) || !finite(in.depths[splat])) return nothing;
  // gsplat's box: floor and ceil of (mean -+ radius) / tile size.
  const float inverse = 1.0f / float(in.tile_size);
  const float low_x = (x - float(rx)) * inverse, high_x = (x + float(rx)) * inverse;
  const float low_y = (y - float(ry)) * inverse, high_y = (y + float(ry)) * inverse;
  const int x0 = clamp_to(low_x, in.tile_width), x1 = clamp_to(__builtin_ceilf(high_x), in.tile_width);
  const int y0 = clamp_to(low_y, in.tile_height), y1 = clamp_to(__builtin_ceilf(high_y), in.tile_height);
  if (x0 >= x1 || y0 >= y1) return nothing;
  TileSpan span = {uint16_t(x0), uint16_t(y0), uint16_t(x1 - x0), uint16_t(y1 - y0), 0};
  Ellipse e;
  bool ellipse = false;
  if (in.conics != nullptr) {
    const float* conic = in.conics + 3 * splat;
    if (!(k >= 0) || !finite(k) || !finite(conic[0]) || !finite(conic[1]) || !finite(conic[2])) return nothing;
    ellipse = make_ellipse(in, splat, k, e);
  }
  if (span.width > 8 || span.height > 8) return span;
  for (int row = 0; row < span.height; ++row) {
    Run run = {0, span.width};
    if (ellipse) {
      run = run_of_row(e, y0 + row, in.tile_size, {x0, x1});
      run.first -= x0, run.end -= x0;
    }
    if (run.first < run.end) span.touched |= uint64_t((1u << run.end) - (1u << run.first)) << (8 * row);
  }
  return span.touched == 0 ? nothing : span;
}

// Where the counters of this splat's image start.
GSPLAT_INLINE int64_t first_tile(const SplatBoxes& in, int64_t splat) {
  const int64_t image = in.image_ids != nullptr ? in.image_ids[splat] : splat < in.per_image ? 0 : splat / in.per_image;
  return image * in.tile_width * in.tile_height;
}

// visit(tile) for every touched tile, row by row.
template <class Visit>
GSPLAT_INLINE void for_tiles(const SplatBoxes& in, int64_t splat, const TileSpan& span, const Visit& visit) {
  const int64_t origin = int64_t(span.y) * in.tile_width + span.x;
  if (span.width <= 8 && span.height <= 8) {
    for (uint64_t left = span.touched; left != 0; left &= left - 1) {
      const int bit = __builtin_ctzll(left);
      visit(origin + int64_t(bit >> 3) * in.tile_width + (bit & 7));
    }
    return;
  }
  Ellipse e;
  const bool ellipse = in.conics != nullptr && make_ellipse(in, splat, contour(in.opacities[splat]), e);
  for (int row = 0; row < span.height; ++row) {
    Run run = {span.x, span.x + span.width};
    if (ellipse) run = run_of_row(e, span.y + row, in.tile_size, run);
    const int64_t start = int64_t(span.y + row) * in.tile_width;
    for (int column = run.first; column < run.end; ++column) visit(start + column);
  }
}

void spans(const SplatBoxes& in, int64_t begin, int64_t end, TileSpan* spans, int32_t* tile_counts) {
  for (int64_t first = begin; first < end; first += kLanes) {
    const int n = end - first < kLanes ? int(end - first) : kLanes;
    float contours[kLanes] = {};
    if (in.conics != nullptr) {
      for (int i = 0; i < n; ++i) contours[i] = in.opacities[first + i];
      const vfloat o = load(contours);
      // 2 ln(255 o); what is not positive and finite has no contour.
      const vfloat k = fma(log2(o * 255.0f), splat(1.3862944f), splat(1e-3f));
      store(contours, where(above(o, vfloat{}) & at_least(splat(3e38f), o), k, splat(-1.0f)));
    }
    for (int i = 0; i < n; ++i) {
      const TileSpan span = span_of(in, first + i, contours[i]);
      int64_t tiles = 0;
      if (span.width <= 8 && span.height <= 8) {
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
    int32_t* const mine = counters + first_tile(in, order[i]);
    for_tiles(in, order[i], spans[order[i]], [&](int64_t tile) { ++mine[tile]; });
  }
}

// The bits that n values need, as gsplat counts them: floor(log2(n)) + 1.
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

extern const TilesKernels tiles_kernels = {spans, count, emit, emit_one};

}  // namespace GSPLAT_ISA
