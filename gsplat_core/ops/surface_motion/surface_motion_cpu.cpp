// Processes a vector of points at a time; the flow's cells are gathered lane by lane.
#include "simd.h"
#include "surface_motion.h"
#include "transposed_rows.h"

namespace GSPLAT_ISA::surface_motion {

using namespace gsplat::surface_motion;

namespace {

struct Pixels {
  vfloat x, y;
};

// Points in camera space and their pixels.
struct Seen {
  vfloat depth;
  Pixels at;
  vint inside;  // inside of the image and in front of the camera
};

GSPLAT_INLINE Seen seen_by(const View& view, const vfloat* p) {
  const float* const r = view.rotation;
  vfloat local[3];
  for (int i = 0; i < 3; ++i) local[i] = r[3 * i] * p[0] + r[3 * i + 1] * p[1] + r[3 * i + 2] * p[2] + view.translation[i];
  Seen s;
  s.depth = max(local[2], splat(kNearest));
  s.at = {local[0] / s.depth * view.fx + view.cx, local[1] / s.depth * view.fy + view.cy};
  s.inside = (s.at.x >= 0.0f) & (s.at.y >= 0.0f) & (s.at.x <= view.width) & (s.at.y <= view.height) & (local[2] > kNearest);
  return s;
}

// Sample the flow at pixels, bilinearly between cell centres. Positions beyond the outermost centres, and NaN, are
// clamped to the edge.
GSPLAT_INLINE Pixels flow_at(const Flow& flow, const Pixels& pixels) {
  const vfloat x = min(max(pixels.x * (float(flow.width) / flow.picture_width) - 0.5f, vfloat{}), splat(float(flow.width - 1)));
  const vfloat y =
      min(max(pixels.y * (float(flow.height) / flow.picture_height) - 0.5f, vfloat{}), splat(float(flow.height - 1)));
  const vfloat left = truncate(x), top = truncate(y), right = x - left, down = y - top;
  const vint column = to_int(left), row = to_int(top);
  vfloat corners[4][2];
  for (int i = 0; i < kLanes; ++i) {
    const int64_t next = column[i] + 1 < flow.width ? 2 : 0, below = row[i] + 1 < flow.height ? 2 * flow.width : 0;
    const float* const cell = flow.cells + 2 * (row[i] * flow.width + column[i]);
    for (int c = 0; c < 2; ++c) {
      corners[0][c][i] = cell[c];
      corners[1][c][i] = cell[next + c];
      corners[2][c][i] = cell[below + c];
      corners[3][c][i] = cell[below + next + c];
    }
  }
  vfloat mixed[2];
  for (int c = 0; c < 2; ++c) {
    const vfloat upper = corners[0][c] + right * (corners[1][c] - corners[0][c]);
    const vfloat lower = corners[2][c] + right * (corners[3][c] - corners[2][c]);
    mixed[c] = upper + down * (lower - upper);
  }
  return {mixed[0], mixed[1]};
}

// Convert the motion of pixels to motion in world space, at the points' depth in `view`.
GSPLAT_INLINE void to_world(const View& view, vfloat depth, const Pixels& moved, vint inside, vfloat* world) {
  const vfloat x = select(inside, moved.x * depth / view.fx, vfloat{}), y = select(inside, moved.y * depth / view.fy, vfloat{});
  for (int i = 0; i < 3; ++i) world[i] = x * view.rotation[i] + y * view.rotation[3 + i];
}

GSPLAT_INLINE void ahead_of(const View& before, const View& after, const Flow& flow, const vfloat* points, vfloat* world) {
  const Seen seen = seen_by(before, points), later = seen_by(after, points);
  const Pixels moved = flow_at(flow, seen.at);
  to_world(after, later.depth, {seen.at.x + moved.x - later.at.x, seen.at.y + moved.y - later.at.y}, seen.inside, world);
}

GSPLAT_INLINE void arrived_at(const View& before, const View& after, const Flow& flow, const vfloat* points, vfloat* world) {
  const Seen seen = seen_by(after, points), earlier = seen_by(before, points);
  Pixels from = seen.at;
  for (int step = 0; step < kInverseSteps; ++step) {
    const Pixels moved = flow_at(flow, from);
    from = {seen.at.x - moved.x, seen.at.y - moved.y};
  }
  to_world(before, earlier.depth, {earlier.at.x - from.x, earlier.at.y - from.y}, seen.inside, world);
}

template <class Motion>
GSPLAT_INLINE void for_points(const float* points, float* motion, int64_t begin, int64_t end, const Motion& of) {
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    vfloat at[3], world[3];
    load_rows<3>(points, first, count, at);
    of(at, world);
    store_rows<3>(motion, first, count, world);
  }
}

void ahead(const View& before, const View& after, const Flow& flow, const float* points, float* motion, int64_t begin,
           int64_t end) {
  for_points(points, motion, begin, end, [&](const vfloat* at, vfloat* world) { ahead_of(before, after, flow, at, world); });
}

void path(const Flows& flows, const float* points, float* positions, int64_t begin, int64_t end) {
  const int64_t cells = 2 * flows.height * flows.width;
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    vfloat at[3], moved[3];
    load_rows<3>(points, first, count, at);
    View before = view_of(flows.views);
    for (int64_t step = 0; step < flows.steps; ++step) {
      const View after = view_of(flows.views + (step + 1) * kViewNumbers);
      ahead_of(before, after, {flows.cells + step * cells, flows.height, flows.width, after.height, after.width}, at, moved);
      for (int c = 0; c < 3; ++c) at[c] += moved[c];
      for (int i = 0; i < count; ++i) {
        for (int c = 0; c < 3; ++c) positions[((first + i) * flows.steps + step) * 3 + c] = at[c][i];
      }
      before = after;
    }
  }
}

void arrived(const View& before, const View& after, const Flow& flow, const float* points, float* motion, int64_t begin,
             int64_t end) {
  for_points(points, motion, begin, end, [&](const vfloat* at, vfloat* world) { arrived_at(before, after, flow, at, world); });
}

}  // namespace

extern const Kernels kernels = {ahead, arrived, path};

}  // namespace GSPLAT_ISA::surface_motion
