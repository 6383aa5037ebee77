#include <algorithm>
#include <array>
#include <initializer_list>
#include <tuple>

#include "cpu_call.h"
#include "hexplane.h"

static constexpr int64_t kGrain = 512;
static constexpr int64_t kChannelChunk = 16;  // channels of one plane that one task adds up: one cache line

// Contiguous tensors of one level, kept alive beside the raw pointers.
struct Level {
  Tensor coordinates;
  std::array<Tensor, kPlanes> tensors;
  HexPlanes raw = {};
  int64_t count = 0;

  Level(const Tensor& points, std::initializer_list<const Tensor*> planes, int64_t dims = 3)
      : coordinates(floats(points, "coordinates")) {
    check(coordinates.dim() == 2 && coordinates.size(1) == 4, "coordinates must be [N, 4]");
    count = coordinates.size(0);
    raw.coordinates = data(coordinates);
    raw.channels = (*planes.begin())->size(dims - 1);
    int i = 0;
    for (const Tensor* plane : planes) {
      check(plane->dim() == dims && plane->size(dims - 1) == raw.channels && plane->numel() > 0,
            "every plane must be [V, U, C] (a line [U, C]) with the same C, none empty");
      tensors[i] = floats(*plane, "a plane");
      raw.planes[i] = {data(tensors[i]), int32_t(plane->size(dims - 2)), dims == 3 ? int32_t(plane->size(0)) : 1};
      ++i;
    }
  }
};

static Tensor product(const Level& level, int first, int last) {
  Tensor features = empty_floats({level.count, level.raw.channels});
  float* out = mutable_data(features);
  torch::stable::parallel_for(0, level.count, kGrain, [&](int64_t begin, int64_t end) {
    hexplane_kernels().product(level.raw, first, last, out, begin, end);
  });
  return features;
}

static Tensor hexplane_features(Tensor coordinates, Tensor xy, Tensor xz, Tensor yz, Tensor xt, Tensor yt, Tensor zt) {
  return product(Level(coordinates, {&xy, &xz, &yz, &xt, &yt, &zt}), 0, kPlanes);
}

static Tensor hexplane_space(Tensor coordinates, Tensor xy, Tensor xz, Tensor yz) {
  return product(Level(coordinates, {&xy, &xz, &yz}), 0, 3);
}

static Tensor hexplane_modulate(Tensor space, Tensor coordinates, Tensor xt, Tensor yt, Tensor zt) {
  const Level level(coordinates, {&xt, &yt, &zt}, 2);
  const Tensor s = floats(space, "space");
  check(s.dim() == 2 && s.size(0) == level.count && s.size(1) == level.raw.channels, "space must be [N, C]");
  Tensor features = empty_floats({level.count, level.raw.channels});
  const float* in = data(s);
  float* out = mutable_data(features);
  torch::stable::parallel_for(0, level.count, kGrain,
                              [&](int64_t begin, int64_t end) { hexplane_kernels().modulate(level.raw, in, out, begin, end); });
  return features;
}

// Block by block, points write what each plane's sample should change by; then each task adds up its own channels of its own
// plane in the order of the points. No two tasks share a cell, so the sums are the same for any number of threads.
static std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> hexplane_features_backward(
    Tensor gradient, Tensor coordinates, Tensor xy, Tensor xz, Tensor yz, Tensor xt, Tensor yt, Tensor zt) {
  const Level level(coordinates, {&xy, &xz, &yz, &xt, &yt, &zt});
  const int64_t n = level.count, channels = level.raw.channels;
  const Tensor g = floats(gradient, "gradient");
  check(g.dim() == 2 && g.size(0) == n && g.size(1) == channels, "the gradient must be [N, C]");
  Tensor samples = empty_floats({kPlanes, kBackwardBlock, channels}), points = empty_floats({n, 4});
  std::array<Tensor, kPlanes> planes;
  std::array<float*, kPlanes> out;
  for (int p = 0; p < kPlanes; ++p) {
    planes[p] = zero_floats({level.tensors[p].size(0), level.tensors[p].size(1), channels});
    out[p] = mutable_data(planes[p]);
  }
  const float* gp = data(g);
  float *sp = mutable_data(samples), *xp = mutable_data(points);
  const int64_t chunks = (channels + kChannelChunk - 1) / kChannelChunk;
  for (int64_t block = 0; block < n; block += kBackwardBlock) {
    const int64_t block_end = std::min(n, block + kBackwardBlock);
    torch::stable::parallel_for(block, block_end, kBackwardBlock / 16, [&](int64_t begin, int64_t end) {
      hexplane_kernels().backward_samples(level.raw, gp, sp, xp, block, begin, end);
    });
    torch::stable::parallel_for(0, kPlanes * chunks, 1, [&](int64_t begin, int64_t end) {
      for (int64_t task = begin; task < end; ++task) {
        const int plane = int(task % kPlanes);
        const int64_t first = task / kPlanes * kChannelChunk, last = std::min(channels, first + kChannelChunk);
        hexplane_kernels().scatter(level.raw, plane, sp, out[plane], first, last, block, block_end);
      }
    });
  }
  return {points, planes[0], planes[1], planes[2], planes[3], planes[4], planes[5]};
}

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CPU, m) {
  m.impl("hexplane_features", GSPLAT_BOX(&hexplane_features));
  m.impl("hexplane_features_backward", GSPLAT_BOX(&hexplane_features_backward));
  m.impl("hexplane_space", GSPLAT_BOX(&hexplane_space));
  m.impl("hexplane_modulate", GSPLAT_BOX(&hexplane_modulate));
}
