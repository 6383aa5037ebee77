// Normals of depth maps, row by row.
#include <cmath>

#include "depth_to_normal_math.h"

namespace GSPLAT_ISA::depth_to_normal {

template <class Work>
static void for_each_row(const Maps& maps, int64_t begin, int64_t end, const Work& work) {
  for (int64_t row = begin; row < end; ++row) work(view_of(maps, row / maps.height), row / maps.height, int(row % maps.height));
}

static void normals(const Maps& maps, float* out, int64_t begin, int64_t end) {
  for_each_row(maps, begin, end, [&](const View& view, int64_t image, int y) {
    for (int x = 0; x < maps.width; ++x) write_normal(maps, view, image, x, y, out);
  });
}

static void gradients(const Maps& maps, const float* v_normals, float* v_depths, int64_t begin, int64_t end) {
  for_each_row(maps, begin, end, [&](const View& view, int64_t image, int y) {
    for (int x = 0; x < maps.width; ++x) write_gradient(maps, view, image, x, y, v_normals, v_depths);
  });
}

extern const Kernels kernels = {normals, gradients};

}  // namespace GSPLAT_ISA::depth_to_normal
