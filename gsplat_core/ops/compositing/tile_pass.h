// CPU host code shared by the ops that blend the lists of tiles: checks of the lists, a parallel loop over tiles, and one
// gradient row per instance (a splat in a tile).
#pragma once

#include <algorithm>
#include <atomic>

#include "compositing.h"
#include "counting_sort.h"
#include "tensor_checks.h"

namespace gsplat::compositing {
namespace {

struct alignas(64) Line {
  float floats[16];
};

// Position of the first tile's list. Earlier entries are unused: lists of a fixed capacity are filled from the end.
int64_t first_listed(const Inputs& in) { return in.tiles() > 0 ? in.offsets[0] : in.instances; }

// Validate the caller's lists; an out-of-range index would read outside of the tensors.
void check_lists(const Inputs& in) {
  int32_t before = 0;
  bool ordered = true;
  for (int64_t i = 0; i < in.tiles(); ++i) ordered &= in.offsets[i] >= before, before = in.offsets[i];
  check(ordered && before <= in.instances, "isect_offsets must rise from 0 to at most the length of flatten_ids");
  uint32_t most = 0;
  for (int64_t i = first_listed(in); i < in.instances; ++i) most = std::max(most, uint32_t(in.flatten_ids[i]));
  check(first_listed(in) == in.instances || most < in.count, "flatten_ids must be in [0, ", in.count, "), found ", int32_t(most));
}

// Call run(tile, scratch) for all tiles, with `scratch_floats` of aligned memory per thread. Threads take the next free
// tiles; no result depends on the assignment.
template <class Run>
void for_tiles(int64_t tiles, int64_t scratch_floats, const Run& run) {
  constexpr int64_t kRun = 4;
  std::atomic<int64_t> next{0};
  const int64_t workers = std::max<int64_t>(1, std::min<int64_t>(torch::stable::get_num_threads(), tiles));
  torch::stable::parallel_for(0, workers, 1, [&](int64_t, int64_t) {
    const auto lines = uninitialised<Line>(scratch_floats / 16 + 1);
    // Take a few adjacent tiles at a time: they share splats, and the next tile's records are prefetched.
    for (int64_t first; (first = next.fetch_add(kRun, std::memory_order_relaxed)) < tiles;)
      for (int64_t tile = first; tile < std::min(first + kRun, tiles); ++tile) run(tile, lines[0].floats);
  });
}

// One row per instance; the rows of a splat are contiguous and in list order.
struct InstanceRows {
  std::unique_ptr<int32_t[]> first, row_of;  // first row of each splat [count + 1], row of each list position
  std::unique_ptr<Line[]> rows;
  int64_t row_size;  // floats

  InstanceRows(const Inputs& in, int64_t values)
      : first(uninitialised<int32_t>(in.count + 1)), row_of(uninitialised<int32_t>(in.instances)) {
    const int64_t unused = first_listed(in), listed = in.instances - unused;
    const int32_t* const ids = in.flatten_ids + unused;
    const auto add = [&](int64_t begin, int64_t end, int32_t* counters) {
      for (int64_t i = begin; i < end; ++i) ++counters[ids[i]];
    };
    counting_sort(listed, 1 << 15, in.count, first.get(), add, [&](int64_t begin, int64_t end, int32_t* cursors) {
      for (int64_t i = begin; i < end; ++i) row_of[unused + i] = cursors[ids[i]]++;
    });
    first[in.count] = int32_t(listed);
    const int64_t lines_per_row = (values + 15) / 16;
    rows = uninitialised<Line>(listed * lines_per_row);
    row_size = 16 * lines_per_row;
  }
};

}  // namespace
}  // namespace gsplat::compositing
