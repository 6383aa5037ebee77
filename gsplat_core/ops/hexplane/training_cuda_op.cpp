#include <optional>
#include <tuple>

#include "field_arguments.h"
#include "planes_adam_cuda.h"

namespace {

using Tensors = std::vector<Tensor>;

// The planes of all levels (xy, xz, yz, xt, yt, zt each) and what is derived from their sizes.
struct Field {
  FieldPlanes planes = {};
  FieldTimePlanes times = {};
  FieldLines lines = {};
  FieldCells cells = {};
  int64_t line_size = 0, features = 0;

  Field(const CudaCall& call, Tensors& tensors, int64_t count) {
    STD_TORCH_CHECK(!tensors.empty() && tensors.size() % 6 == 0 && tensors.size() / 6 <= size_t(kFieldLevels),
                    "planes must be six per level, 1 to ", kFieldLevels, " levels, got ", tensors.size());
    planes.levels = int32_t(tensors.size() / 6);
    planes.channels = int32_t(tensors[0].size(2));
    features = int64_t(planes.levels) * planes.channels;
    Tensors time_planes;
    for (int l = 0; l < planes.levels; ++l) {
      for (int p = 0; p < 6; ++p) {
        Tensor& plane = tensors[6 * l + p];
        STD_TORCH_CHECK(plane.is_contiguous(), "planes must be contiguous");
        call.floats(plane, "a plane");
        STD_TORCH_CHECK(plane.dim() == 3 && plane.size(2) == planes.channels && plane.numel() > 0, "every plane must be [V, U, ",
                        planes.channels, "], none empty");
        if (p < 3) planes.space[l][p] = data(plane);
        if (p >= 3) time_planes.push_back(plane);
      }
      const auto size = [&](int p, int dim) { return int32_t(tensors[6 * l + p].size(dim)); };
      int32_t* sizes = planes.sizes[l];
      sizes[0] = size(0, 1), sizes[1] = size(0, 0), sizes[2] = size(1, 0);
      STD_TORCH_CHECK(size(1, 1) == sizes[0] && size(2, 1) == sizes[1] && size(2, 0) == sizes[2] && size(3, 1) == sizes[0] &&
                          size(4, 1) == sizes[1] && size(5, 1) == sizes[2],
                      "the planes of level ", l, " do not share one grid");
      for (int p = 0; p < 3; ++p) {
        cells.first[l][p] = cells.cells;
        cells.cells += int64_t(sizes[major_axis(p)]) * sizes[minor_axis(p)];
      }
    }
    line_size = lines_of(call, time_planes, planes.channels, times, lines);
    cells.count = count;
    STD_TORCH_CHECK(cells.cells < (int64_t(1) << 31) && 3 * planes.levels * count < (int64_t(1) << 31),
                    "too many cells or Gaussians for 32-bit places: ", cells.cells, " cells, ", count, " Gaussians");
  }
};

FieldNetwork checked_network(const CudaCall& call, Tensors& weights, Tensors& biases, const Field& field) {
  const FieldNetwork net = network_of(call, weights, biases, field.features);
  STD_TORCH_CHECK(field.planes.channels % 16 == 0 && net.fits(4),
                  "training on CUDA takes a multiple of 16 channels, layers up to 128 ", "wide, and weights that fit into ",
                  kRoomForWeights, " bytes; got ", field.planes.channels, " channels, width ", net.width, ", ", net.layers,
                  " layers; train with autograd");
  return net;
}

// (deltas [N, 16], coordinates [N, 4], lines, features [N, levels * C], hidden [layers - 1, N, width])
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> hexplane_train(Tensor means, Tensor box, Tensor time, Tensors planes,
                                                                  Tensors weights, Tensors biases) {
  CudaCall call(means);
  const Tensor m = call.floats(means, "means"), b = call.floats(box, "box"), t = call.floats(time, "time");
  STD_TORCH_CHECK(m.dim() == 2 && m.size(1) == 3 && b.numel() == 6 && t.numel() == 1,
                  "hexplane_train takes means [N, 3], box [2, 3] and one time");
  const int64_t n = m.size(0);
  Field field(call, planes, n);
  const FieldNetwork net = checked_network(call, weights, biases, field);
  Tensor deltas = call.empty({n, kDeltaColumns}), coordinates = call.empty({n, 4}), lines = call.empty({field.line_size});
  Tensor features = call.empty({n, field.features}), hidden = call.empty({net.layers - 1, n, net.width});
  field.lines.values = mutable_data(lines);
  field.cells.coordinates = mutable_data(coordinates);
  FieldInput lines_only = {};
  lines_only.lines = field.lines, lines_only.levels = field.planes.levels, lines_only.channels = field.planes.channels;
  void* packed = call.bytes(net.packed_bytes(4));
  prepare_field(field.times, lines_only, data(t), &net, packed, false, call.stream);
  place_gaussians(field.planes, data(m), data(b), field.cells, call, call.stream);
  field_features(field.planes, field.lines, field.cells, mutable_data(features), call.stream);
  FieldInput in = {};
  in.spaces[0] = data(features), in.count = n, in.levels = 1, in.channels = int32_t(field.features);
  field_deltas(in, net, packed, false, mutable_data(deltas), mutable_data(hidden), call.stream);
  check_cuda(cudaGetLastError(), "hexplane_train");
  return {deltas, coordinates, lines, features, hidden};
}

// (network gradient, rows [2, slots, N, C], items, starts, line gradient); adds the positions' gradient to v_raw.
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> hexplane_train_backward(Tensor v_raw, Tensor means, Tensor box, Tensor lines,
                                                                           Tensor features, Tensor hidden, Tensors planes,
                                                                           Tensors weights, Tensors biases) {
  CudaCall call(means);
  const Tensor m = call.floats(means, "means"), b = call.floats(box, "box");
  const int64_t n = m.size(0);
  STD_TORCH_CHECK(v_raw.is_contiguous() && v_raw.dim() == 2 && v_raw.size(0) == n && v_raw.size(1) == kDeltaColumns,
                  "v_raw must be contiguous [N, ", kDeltaColumns, "]");
  call.floats(v_raw, "v_raw");
  Field field(call, planes, n);
  const FieldNetwork net = checked_network(call, weights, biases, field);
  const Tensor l = call.floats(lines, "lines"), f = call.floats(features, "features"), h = call.floats(hidden, "hidden");
  STD_TORCH_CHECK(
      l.numel() == field.line_size && f.numel() == n * field.features && h.numel() == (net.layers - 1) * n * net.width,
      "lines, features and hidden must be those that hexplane_train gave");
  const int64_t slots = 3 * field.planes.levels;
  int64_t parameters = 0;
  for (size_t i = 0; i < weights.size(); ++i) parameters += weights[i].numel() + biases[i].numel();
  Tensor network_gradient = call.empty({parameters}), rows = call.empty({2, slots, n, field.planes.channels});
  Tensor items = call.empty({slots * n}, ScalarType::Int), starts = call.empty({field.cells.cells + 1}, ScalarType::Int);
  Tensor v_lines = call.empty({field.line_size});
  field.lines.values = const_cast<float*>(data(l));
  field.cells.coordinates = call.array<float>(4 * n);
  field.cells.items = items.mutable_data_ptr<int32_t>(), field.cells.starts = starts.mutable_data_ptr<int32_t>();
  const FieldRows r = {mutable_data(rows), mutable_data(rows) + slots * n * field.planes.channels};
  float *v_features = call.array<float>(n * field.features), *v_hidden = call.array<float>((net.layers - 1) * n * net.width);
  float* v_head = call.array<float>(n * kDeltaColumns);
  place_gaussians(field.planes, data(m), data(b), field.cells, call, call.stream);
  network_backward(net, data(v_raw), data(h), v_features, v_hidden, v_head, n, call.stream);
  network_weight_gradient(net, data(f), data(h), v_hidden, v_head, mutable_data(network_gradient), n, call, call.stream);
  field_rows(field.planes, field.lines, field.cells, data(b), v_features, r, mutable_data(v_raw), call.stream);
  line_gradient(field.planes, field.lines, field.cells, r, mutable_data(v_lines), call, call.stream);
  check_cuda(cudaGetLastError(), "hexplane_train_backward");
  return {network_gradient, rows, items, starts, v_lines};
}

// What hexplane_train_backward left, as the pass over the planes takes it.
struct Backward {
  Tensor coordinates, time, rows, items, starts, v_lines;
  FieldRows raw = {};

  Backward(const CudaCall& call, Field& field, const Tensor& coordinates_, const Tensor& time_, const Tensor& rows_,
           const Tensor& items_, const Tensor& starts_, const Tensor& v_lines_)
      : coordinates(call.floats(coordinates_, "coordinates")),
        time(call.floats(time_, "time")),
        rows(call.floats(rows_, "rows")),
        items(call.ints(items_, "items")),
        starts(call.ints(starts_, "starts")),
        v_lines(call.floats(v_lines_, "line gradient")) {
    const int64_t values = 3 * field.planes.levels * field.cells.count;
    STD_TORCH_CHECK(items.numel() == values && rows.numel() == 2 * values * field.planes.channels &&
                        starts.numel() == field.cells.cells + 1 && v_lines.numel() == field.line_size && time.numel() == 1,
                    "rows, items, starts and line gradient must be those that hexplane_train_backward gave");
    field.cells.coordinates = const_cast<float*>(data(coordinates));
    field.cells.items = const_cast<int32_t*>(items.const_data_ptr<int32_t>());
    field.cells.starts = const_cast<int32_t*>(starts.const_data_ptr<int32_t>());
    raw.space = const_cast<float*>(data(rows));
    raw.lines = raw.space + values * field.planes.channels;
  }
};

Tensors hexplane_planes_gradient(Tensor coordinates, Tensor time, Tensor rows, Tensor items, Tensor starts, Tensor v_lines,
                                 Tensors planes) {
  CudaCall call(coordinates);
  Field field(call, planes, coordinates.size(0));
  const Backward backward(call, field, coordinates, time, rows, items, starts, v_lines);
  PlaneGradients gradients = {};
  Tensors out;
  for (size_t i = 0; i < planes.size(); ++i) {
    out.push_back(call.empty({planes[i].size(0), planes[i].size(1), planes[i].size(2)}));
    const size_t level = i / 6, p = i % 6;
    (p < 3 ? gradients.space[level][p] : gradients.time[level][p - 3]) = mutable_data(out.back());
    if (p >= 3) gradients.time_rows[level][p - 3] = int32_t(planes[i].size(0));
  }
  planes_gradient(field.planes, field.lines, field.cells, backward.raw, data(backward.v_lines), data(backward.time), gradients,
                  call.stream);
  check_cuda(cudaGetLastError(), "hexplane_planes_gradient");
  return out;
}

void hexplane_planes_adam_(Tensors planes, Tensors first, Tensors second, Tensor coordinates, Tensor time, Tensor rows,
                           Tensor items, Tensor starts, Tensor v_lines, Tensor rate, Tensor step, std::optional<Tensor> status,
                           double beta1, double beta2, double epsilon, double smoothness, double time_smoothness,
                           double sparsity) {
  CudaCall call(coordinates);
  Field field(call, planes, coordinates.size(0));
  const Backward backward(call, field, coordinates, time, rows, items, starts, v_lines);
  STD_TORCH_CHECK(first.size() == planes.size() && second.size() == planes.size(), "every plane needs its two moments");
  PlanesState state = {};
  for (size_t i = 0; i < planes.size(); ++i) {
    for (const Tensor* moment : {&first[i], &second[i]}) {
      call.floats(*moment, "a moment");
      STD_TORCH_CHECK(moment->is_contiguous() && moment->numel() == planes[i].numel(),
                      "moments must be contiguous and of their plane's size");
    }
    const size_t level = i / 6, p = i % 6;
    (p < 3 ? state.space[level][p] : state.time[level][p - 3]) = {mutable_data(planes[i]), mutable_data(first[i]),
                                                                  mutable_data(second[i])};
    if (p >= 3) state.time_rows[level][p - 3] = int32_t(planes[i].size(0));
  }
  STD_TORCH_CHECK(smoothness == 0 || field.planes.channels <= 512, "the penalty on space planes takes up to 512 channels, got ",
                  field.planes.channels);
  const Tensor now = call.floats(rate, "rate"), count = call.take(step, ScalarType::Long, "step");
  std::optional<Tensor> cut;
  if (status.has_value()) cut = call.ints(*status, "status");
  STD_TORCH_CHECK(now.numel() == 1 && count.numel() == 1 && (!cut.has_value() || cut->numel() >= 3),
                  "rate and step must be one number each, and status four");
  const PlanesAdam options = {data(now),
                              count.const_data_ptr<int64_t>(),
                              cut.has_value() ? cut->const_data_ptr<int32_t>() : nullptr,
                              beta1,
                              beta2,
                              epsilon,
                              {float(smoothness), float(time_smoothness), float(sparsity)}};
  planes_adam(field.planes, field.lines, field.cells, backward.raw, data(backward.v_lines), data(backward.time), state, options,
              call, call.stream);
  check_cuda(cudaGetLastError(), "hexplane_planes_adam_");
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("hexplane_train", TORCH_BOX(&hexplane_train));
  m.impl("hexplane_train_backward", TORCH_BOX(&hexplane_train_backward));
  m.impl("hexplane_planes_gradient", TORCH_BOX(&hexplane_planes_gradient));
  m.impl("hexplane_planes_adam_", TORCH_BOX(&hexplane_planes_adam_));
}
