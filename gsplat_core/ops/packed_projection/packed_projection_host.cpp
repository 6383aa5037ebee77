#include <tuple>

#include "../projection/projection_scene.h"
#include "host_call.h"
#include "packed_projection.h"
#include "threads.h"

namespace gsplat::packed_projection {
namespace {

using projection::at;
using projection::CameraModel;
using projection::of_camera;
using projection::Scene;

struct Packed {
  Tensor ids, radii, means2d, depths, conics, compensations;

  Packed(const Call& call, int64_t rows, bool compensate)
      : ids(call.empty({rows}, ScalarType::Long)),
        radii(call.empty({rows, 2}, ScalarType::Int)),
        means2d(call.empty({rows, 2})),
        depths(call.empty({rows})),
        conics(call.empty({rows, 3})),
        compensations(compensate ? call.empty({rows}) : call.empty({0})),
        out{ids.mutable_data_ptr<int64_t>(),
            radii.mutable_data_ptr<int32_t>(),
            mutable_data(means2d),
            mutable_data(depths),
            mutable_data(conics),
            compensate ? mutable_data(compensations) : nullptr} {}

  RowOutput out;
};

#if defined(GSPLAT_CUDA)

Packed forward(Call& call, const Scene& scene, bool compensate) {
  int64_t rows = 0;
  const int64_t count = blocks(scene.size);
  if (count == 0) return Packed(call, 0, compensate);
  const Visible visible = find_visible(scene.input, scene.size, compensate, call, call.stream);
  // The only host synchronisation: it provides the number of rows.
  check_cuda(cudaMemcpyAsync(&rows, visible.starts + count, sizeof(rows), cudaMemcpyDeviceToHost, call.stream),
             "reading the number of visible Gaussians");
  check_cuda(cudaStreamSynchronize(call.stream), "finding visible Gaussians");
  Packed packed(call, rows, compensate);
  if (rows > 0) emit_rows(scene.input, scene.size, visible, packed.out, call.stream);
  return packed;
}

void backward(Call& call, const Scene& scene, const Rows& rows, const RowOutputGradient& from, RowGradient to,
              float* v_viewmats) {
  if (v_viewmats != nullptr) to.viewmat = call.array<float>(blocks(scene.size) * 12);
  rows_backward(scene.input, scene.size, rows, from, to, v_viewmats, call.stream);
}

void add(const Call& call, const ProjectionSize& size, const Rows& rows, const float* values, int64_t columns, float* out) {
  add_rows(size, rows, values, columns, out, call.stream);
}

void check_ids(const Rows&, const ProjectionSize&) {}  // the kernels ignore other ids

#else

constexpr int64_t kBlock = 1024;  // pairs of one image per task; a multiple of every vector width and of 64
constexpr int64_t kWords = kBlock / 64;

// Inputs of up to kBlock Gaussians, gathered by index.
struct Gathered {
  float means[3 * kBlock], covars[6 * kBlock], quats[4 * kBlock], scales[3 * kBlock], opacities[kBlock];
  ProjectionInput input;

  // Gather the inputs of up to kBlock Gaussians. `index(i)` returns the number of the i-th Gaussian.
  template <class Index>
  Gathered(const ProjectionInput& from, int64_t count, const Index& index) : input(from) {
    gather<3>(from.means, means, count, index);
    if (from.covars != nullptr) gather<6>(from.covars, covars, count, index);
    if (from.quats != nullptr) gather<4>(from.quats, quats, count, index);
    if (from.scales != nullptr) gather<3>(from.scales, scales, count, index);
    if (from.opacities != nullptr) gather<1>(from.opacities, opacities, count, index);
    input.means = means;
    input.covars = from.covars != nullptr ? covars : nullptr;
    input.quats = from.quats != nullptr ? quats : nullptr;
    input.scales = from.scales != nullptr ? scales : nullptr;
    input.opacities = from.opacities != nullptr ? opacities : nullptr;
  }

 private:
  template <int K, class Index>
  static void gather(const float* from, float* to, int64_t count, const Index& index) {
    for (int64_t i = 0; i < count; ++i)
      for (int k = 0; k < K; ++k) to[K * i + k] = from[K * index(i) + k];
  }
};

ProjectionInput of_image(const Scene& scene, int64_t image) {
  return of_camera(scene.input, scene.size, image / scene.size.cameras, image % scene.size.cameras);
}

// Project in two passes: the first finds visible pairs of camera and Gaussian, the second projects them into memory for
// exactly their number.
Packed forward(Call& call, const Scene& scene, bool compensate) {
  const int64_t N = scene.size.gaussians, images = scene.size.batches * scene.size.cameras;
  const int64_t per_image = (N + kBlock - 1) / kBlock, count = images * per_image;
  uint64_t* const bits = call.array<uint64_t>(count * kWords);
  int64_t* const starts = call.array<int64_t>(count + 1);
  for_blocks(images, N, kBlock, [&](int64_t image, int64_t begin, int64_t end) {
    int32_t radii[2 * kBlock];
    float means2d[2 * kBlock], depths[kBlock], conics[3 * kBlock], compensations[kBlock];
    ProjectionInput in = of_image(scene, image);
    in.means += 3 * begin, in.covars = at(in.covars, 6 * begin), in.quats = at(in.quats, 4 * begin);
    in.scales = at(in.scales, 3 * begin), in.opacities = at(in.opacities, begin);
    projection::kernels().forward(in, {radii, means2d, depths, conics, compensate ? compensations : nullptr}, 0, end - begin);
    const int64_t block = image * per_image + begin / kBlock;
    int64_t visible = 0;
    for (int64_t word = 0; word < kWords; ++word) {
      uint64_t value = 0;
      for (int64_t bit = 0; bit < 64 && 64 * word + bit < end - begin; ++bit)
        value |= uint64_t(radii[2 * (64 * word + bit)] > 0) << bit;
      bits[block * kWords + word] = value;
      visible += __builtin_popcountll(value);
    }
    starts[block + 1] = visible;
  });
  starts[0] = 0;
  for (int64_t block = 0; block < count; ++block) starts[block + 1] += starts[block];
  Packed packed(call, starts[count], compensate);
  for_blocks(images, N, kBlock, [&](int64_t image, int64_t begin, int64_t end) {
    const int64_t block = image * per_image + begin / kBlock, first = starts[block], rows = starts[block + 1] - first;
    if (rows == 0) return;
    int64_t* const ids = packed.out.ids + first;
    int64_t row = 0;
    for (int64_t i = 0; i < end - begin; ++i)
      if (bits[block * kWords + i / 64] >> (i % 64) & 1) ids[row++] = image * N + begin + i;
    const Gathered gathered(of_image(scene, image), rows, [&](int64_t i) { return ids[i] - image * N; });
    const projection::ProjectionOutput out = {packed.out.radii + 2 * first, packed.out.means2d + 2 * first,
                                              packed.out.depths + first, packed.out.conics + 3 * first,
                                              at(packed.out.compensations, first)};
    projection::kernels().forward(gathered.input, out, 0, rows);
  });
  return packed;
}

// Return the first row whose id is at least `id`; rows are sorted by id.
int64_t first_row(const Rows& rows, int64_t id) { return std::lower_bound(rows.ids, rows.ids + rows.count, id) - rows.ids; }

void backward(Call& call, const Scene& scene, const Rows& rows, const RowOutputGradient& from, const RowGradient& to,
              float* v_viewmats) {
  const int64_t N = scene.size.gaussians, images = scene.size.batches * scene.size.cameras;
  const int64_t per_image = (N + kBlock - 1) / kBlock;
  float* const sums = v_viewmats == nullptr ? nullptr : call.array<float>(images * per_image * 12);
  for_blocks(images, N, kBlock, [&](int64_t image, int64_t begin, int64_t end) {
    const int64_t first = first_row(rows, image * N + begin), count = first_row(rows, image * N + end) - first;
    float* const sum = at(sums, (image * per_image + begin / kBlock) * 12);
    for (int i = 0; sum != nullptr && i < 12; ++i) sum[i] = 0;
    if (count == 0) return;
    const Gathered gathered(of_image(scene, image), count, [&](int64_t i) { return rows.ids[first + i] - image * N; });
    int32_t radii[2 * kBlock];
    for (int64_t i = 0; i < 2 * count; ++i) radii[i] = 1;
    const projection::ProjectionOutputGradient v = {radii, at(from.means2d, 2 * first), at(from.depths, first),
                                                    at(from.conics, 3 * first), at(from.compensations, first)};
    projection::kernels().backward(
        gathered.input, v,
        {to.means + 3 * first, at(to.covars, 6 * first), at(to.quats, 4 * first), at(to.scales, 3 * first), sum, false}, 0,
        count);
  });
  for (int64_t image = 0; v_viewmats != nullptr && image < images; ++image)
    for (int i = 0; i < 12; ++i) {
      double total = 0;
      for (int64_t block = 0; block < per_image; ++block) total += sums[(image * per_image + block) * 12 + i];
      v_viewmats[image * 16 + (i < 9 ? i / 3 * 4 + i % 3 : (i - 9) * 4 + 3)] = float(total);
    }
}

// Each task adds the cameras of a block of Gaussians in order, so sums do not depend on the number of threads.
void add(const Call&, const ProjectionSize& size, const Rows& rows, const float* values, int64_t columns, float* out) {
  const int64_t N = size.gaussians;
  for_blocks(size.batches, N, kBlock, [&](int64_t batch, int64_t begin, int64_t end) {
    for (int64_t camera = 0; camera < size.cameras; ++camera) {
      const int64_t zero = (batch * size.cameras + camera) * N, last = first_row(rows, zero + end);
      for (int64_t row = first_row(rows, zero + begin); row < last; ++row) {
        float* const sum = out + (batch * N + rows.ids[row] - zero) * columns;
        for (int64_t k = 0; k < columns; ++k) sum[k] += values[row * columns + k];
      }
    }
  });
}

void check_ids(const Rows& rows, const ProjectionSize& size) {
  const int64_t end = size.batches * size.cameras * size.gaussians;
  for (int64_t row = 0; row < rows.count; ++row)
    check(rows.ids[row] >= 0 && rows.ids[row] < end && (row == 0 || rows.ids[row - 1] < rows.ids[row]),
          "packed projection: row ids must ascend from 0 to ", end - 1, ", got ", rows.ids[row], " in row ", row);
}

#endif

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> project_visible(
    Tensor means, OptionalTensor covars, OptionalTensor quats, OptionalTensor scales, OptionalTensor opacities, Tensor viewmats,
    Tensor intrinsics, int64_t width, int64_t height, double eps2d, double near_plane, double far_plane, double radius_clip,
    bool compensate, int64_t camera_model, double compensation_floor) {
  Call call(means);
  Scene scene(call, means, covars, quats, scales, opacities, viewmats, intrinsics);
  ProjectionInput& in = scene.input;
  in.width = float(width), in.height = float(height), in.eps2d = float(eps2d);
  in.near_plane = float(near_plane), in.far_plane = float(far_plane), in.radius_clip = float(radius_clip);
  in.model = CameraModel(camera_model), in.compensation_floor = float(compensation_floor);
  const Packed packed = forward(call, scene, compensate);
  call.finish("project_visible");
  return {packed.ids, packed.means2d, packed.depths, packed.conics, packed.compensations, packed.radii};
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> project_visible_backward(
    Tensor means, OptionalTensor covars, OptionalTensor quats, OptionalTensor scales, Tensor viewmats, Tensor intrinsics,
    Tensor ids_, OptionalTensor v_means2d_, OptionalTensor v_depths_, OptionalTensor v_conics_, OptionalTensor v_compensations_,
    int64_t width, int64_t height, double eps2d, int64_t camera_model, bool needs_viewmats, double compensation_floor) {
  Call call(means);
  Scene scene(call, means, covars, quats, scales, std::nullopt, viewmats, intrinsics);
  ProjectionInput& in = scene.input;
  in.width = float(width), in.height = float(height), in.eps2d = float(eps2d), in.model = CameraModel(camera_model);
  in.compensation_floor = float(compensation_floor);
  const Tensor ids = call.take(ids_, ScalarType::Long, "ids");
  const Rows rows = {ids.const_data_ptr<int64_t>(), ids.numel()};
  check_ids(rows, scene.size);
  const OptionalTensor v_means2d = call.floats(v_means2d_, "v_means2d"), v_depths = call.floats(v_depths_, "v_depths"),
                       v_conics = call.floats(v_conics_, "v_conics"),
                       v_compensations = call.floats(v_compensations_, "v_compensations");
  const auto fits = [&](const OptionalTensor& t, int64_t columns) {
    return !t.has_value() || t->numel() == rows.count * columns;
  };
  check(fits(v_means2d, 2) && fits(v_depths, 1) && fits(v_conics, 3) && fits(v_compensations, 1),
        "packed projection backward: the sizes of the gradients do not fit ", rows.count, " rows");
  const bool from_covars = scene.covars.has_value();
  const auto gradient = [&](bool wanted, int64_t columns) {
    return wanted ? call.empty({rows.count, columns}) : call.empty({0});
  };
  Tensor v_means = gradient(true, 3), v_covars = gradient(from_covars, 6), v_quats = gradient(!from_covars, 4),
         v_scales = gradient(!from_covars, 3),
         v_viewmats = needs_viewmats ? call.zeros({scene.size.batches, scene.size.cameras, 4, 4}) : call.empty({0});
  backward(call, scene, rows, {data(v_means2d), data(v_depths), data(v_conics), data(v_compensations)},
           {mutable_data(v_means), from_covars ? mutable_data(v_covars) : nullptr, from_covars ? nullptr : mutable_data(v_quats),
            from_covars ? nullptr : mutable_data(v_scales), nullptr},
           needs_viewmats ? mutable_data(v_viewmats) : nullptr);
  call.finish("project_visible_backward");
  return {v_means, v_covars, v_quats, v_scales, v_viewmats};
}

void add_packed_rows(Tensor out, Tensor values_, Tensor ids_, int64_t cameras) {
  const Call call(out);
  call.in_place(out, "out");
  const Tensor values = call.floats(values_, "values"), ids = call.take(ids_, ScalarType::Long, "ids");
  check(out.dim() == 3 && values.dim() == 2 && values.size(1) == out.size(2) && values.size(0) == ids.numel() && cameras >= 0,
        "add_packed_rows takes out [B, N, D], values [rows, D] and ids [rows]");
  const ProjectionSize size = {out.size(0), cameras, out.size(1)};
  const Rows rows = {ids.const_data_ptr<int64_t>(), ids.numel()};
  check_ids(rows, size);
  add(call, size, rows, data(values), out.size(2), mutable_data(out));
  call.finish("add_packed_rows");
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("project_visible", GSPLAT_BOX(&project_visible));
  m.impl("project_visible_backward", GSPLAT_BOX(&project_visible_backward));
  m.impl("add_packed_rows_", GSPLAT_BOX(&add_packed_rows));
}

}  // namespace gsplat::packed_projection
