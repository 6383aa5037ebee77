// Checked planes of a field, for the CUDA ops of its training.
#pragma once

#include "../hexplane_deltas/field_arguments.h"
#include "training.h"

namespace gsplat::hexplane {

using Tensors = std::vector<Tensor>;

// The planes of all levels (xy, xz, yz, xt, yt, zt each), and quantities derived from their sizes.
struct Field {
  FieldPlanes planes = {};
  FieldTimePlanes times = {};
  FieldLines lines = {};
  FieldCells cells = {};
  int64_t line_size = 0, features = 0;

  Field(const CudaCall& call, Tensors& tensors, int64_t count) {
    check(!tensors.empty() && tensors.size() % 6 == 0 && tensors.size() / 6 <= size_t(kMaxFieldLevels),
          "planes must be six per level, 1 to ", kMaxFieldLevels, " levels, got ", tensors.size());
    planes.levels = int32_t(tensors.size() / 6);
    planes.channels = int32_t(tensors[0].size(2));
    features = int64_t(planes.levels) * planes.channels;
    Tensors time_planes;
    for (int l = 0; l < planes.levels; ++l) {
      for (int p = 0; p < 6; ++p) {
        Tensor& plane = tensors[6 * l + p];
        check(plane.is_contiguous(), "planes must be contiguous");
        call.floats(plane, "a plane");
        check(plane.dim() == 3 && plane.size(2) == planes.channels && plane.numel() > 0, "every plane must be [V, U, ",
              planes.channels, "], none empty");
        if (p < 3) planes.space[l][p] = data(plane);
        if (p >= 3) time_planes.push_back(plane);
      }
      const auto size = [&](int p, int dim) { return int32_t(tensors[6 * l + p].size(dim)); };
      int32_t* sizes = planes.sizes[l];
      sizes[0] = size(0, 1), sizes[1] = size(0, 0), sizes[2] = size(1, 0);
      check(size(1, 1) == sizes[0] && size(2, 1) == sizes[1] && size(2, 0) == sizes[2] && size(3, 1) == sizes[0] &&
                size(4, 1) == sizes[1] && size(5, 1) == sizes[2],
            "the planes of level ", l, " do not share one grid");
      for (int p = 0; p < 3; ++p) {
        cells.first[l][p] = cells.cells;
        cells.cells += int64_t(sizes[major_axis(p)]) * sizes[minor_axis(p)];
      }
    }
    line_size = lines_of(call, time_planes, planes.channels, times, lines);
    cells.count = count;
    check(cells.cells < (int64_t(1) << 31) && 3 * planes.levels * count < (int64_t(1) << 31),
          "too many cells or Gaussians for 32-bit places: ", cells.cells, " cells, ", count, " Gaussians");
  }
};

}  // namespace gsplat::hexplane
