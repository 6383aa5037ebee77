// Host code of hexplane_train and its backward pass: argument checks, memory and kernel launches.
#include <tuple>

#include "cuda_branch.h"
#include "field_planes.h"

namespace gsplat::hexplane {
namespace {

FieldNetwork checked_network(const CudaCall& call, Tensors& weights, Tensors& biases, const Field& field) {
  const FieldNetwork net = network_of(call, weights, biases, field.features);
  check(field.planes.channels % 16 == 0 && net.fits(4), "training on CUDA takes a multiple of 16 channels, layers up to 128 ",
        "wide, and weights that fit into ", kMaxPackedBytes, " bytes; got ", field.planes.channels, " channels, width ",
        net.width, ", ", net.layers, " layers; train with autograd");
  return net;
}

// Set the pointers of `cells`; `order` holds the items, their ranks and their keys.
void set_cells(FieldCells& cells, const Tensor& coordinates, const Tensor& order, const Tensor& starts) {
  const int64_t items = order.size(1);
  int32_t* values = const_cast<int32_t*>(order.const_data_ptr<int32_t>());
  cells.coordinates = const_cast<float*>(data(coordinates));
  cells.items = values, cells.ranks = values + items, cells.keys = reinterpret_cast<uint32_t*>(values + 2 * items);
  cells.starts = const_cast<int32_t*>(starts.const_data_ptr<int32_t>());
}

// Returns (deltas [N, 16], coordinates [N, 4], lines, features [N, levels * C], hidden [layers - 1, N, padded width],
// order [3, slots * N], starts [cells + 1]).
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> hexplane_train(Tensor means, Tensor box, Tensor time,
                                                                                  Tensors planes, Tensors weights,
                                                                                  Tensors biases) {
  CudaCall call(means);
  const Tensor m = call.floats(means, "means"), b = call.floats(box, "box"), t = call.floats(time, "time");
  check(m.dim() == 2 && m.size(1) == 3 && b.numel() == 6 && t.numel() == 1,
        "hexplane_train takes means [N, 3], box [2, 3] and one time");
  const int64_t n = m.size(0);
  Field field(call, planes, n);
  const FieldNetwork net = checked_network(call, weights, biases, field);
  Tensor deltas = call.empty({n, kRawColumns}), coordinates = call.empty({n, 4}), lines = call.empty({field.line_size});
  Tensor features = call.empty({n, field.features}), hidden = call.empty({net.layers - 1, n, net.padded_width()});
  Tensor order = call.empty({3, 3 * field.planes.levels * n}, ScalarType::Int);
  Tensor starts = call.empty({field.cells.cells + 1}, ScalarType::Int);
  field.lines.values = mutable_data(lines);
  set_cells(field.cells, coordinates, order, starts);
  FieldInput lines_only = {};
  lines_only.lines = field.lines, lines_only.levels = field.planes.levels, lines_only.channels = field.planes.channels;
  void* packed = call.bytes(net.packed_bytes(4));
  place_gaussians(data(m), data(b), field.cells, call.stream);
  CudaBranch branch(call.stream);  // only the backward pass needs the sorting
  sort_gaussians(field.planes, field.cells, call, branch.stream);
  prepare_field(field.times, lines_only, data(t), &net, packed, false, call.stream);
  field_features(field.planes, field.lines, field.cells, mutable_data(features), call.stream);
  FieldInput in = {};
  in.spaces[0] = data(features), in.count = n, in.levels = 1, in.channels = int32_t(field.features);
  field_deltas(in, net, packed, false, mutable_data(deltas), mutable_data(hidden), call.stream);
  call.finish("hexplane_train");
  return {deltas, coordinates, lines, features, hidden, order, starts};
}

// Returns (network gradient, rows [2, slots * N, C], fractions, dense_sums, line gradient), and adds the positions'
// gradient to v_raw.
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> hexplane_train_backward(Tensor v_raw, Tensor box, Tensors state,
                                                                           Tensors planes, Tensors weights, Tensors biases) {
  check(state.size() == 6, "hexplane_train_backward: state must be the results of hexplane_train after the deltas, got ",
        state.size(), " tensors");
  const Tensor &coordinates = state[0], &lines = state[1], &features = state[2], &hidden = state[3], &order = state[4],
               &starts = state[5];
  CudaCall call(v_raw);
  const Tensor b = call.floats(box, "box"), x = call.floats(coordinates, "coordinates");
  const Tensor o = call.ints(order, "order"), s = call.ints(starts, "starts");
  const int64_t n = x.size(0);
  check(v_raw.is_contiguous() && v_raw.dim() == 2 && v_raw.size(0) == n && v_raw.size(1) == kRawColumns,
        "v_raw must be contiguous [N, ", kRawColumns, "]");
  call.floats(v_raw, "v_raw");
  Field field(call, planes, n);
  const FieldNetwork net = checked_network(call, weights, biases, field);
  const Tensor l = call.floats(lines, "lines"), f = call.floats(features, "features"), h = call.floats(hidden, "hidden");
  const int64_t slots = 3 * field.planes.levels;
  check(x.numel() == 4 * n && l.numel() == field.line_size && f.numel() == n * field.features &&
            h.numel() == (net.layers - 1) * n * net.padded_width() && o.dim() == 2 && o.numel() == 3 * slots * n &&
            s.numel() == field.cells.cells + 1,
        "coordinates, lines, features, hidden, order and starts must be those that hexplane_train gave");
  int64_t parameters = 0;
  for (size_t i = 0; i < weights.size(); ++i) parameters += weights[i].numel() + biases[i].numel();
  Tensor network_gradient = call.empty({parameters}), rows = call.empty({2, slots * n, field.planes.channels});
  Tensor fractions = call.empty({slots * n, 2});
  Tensor v_lines = call.empty({field.line_size}), dense_sums = call.empty({(slots * n + 31) / 32, 5, 4, field.planes.channels});
  field.lines.values = const_cast<float*>(data(l));
  set_cells(field.cells, x, o, s);
  const FieldRows r = {mutable_data(rows), mutable_data(rows) + slots * n * field.planes.channels, mutable_data(fractions),
                       mutable_data(dense_sums)};
  float *v_features = call.array<float>(n * field.features), *v_hidden = call.array<float>(h.numel());
  float* v_head = call.array<float>(n * kRawColumns);
  network_backward(net, data(v_raw), data(h), v_features, v_hidden, v_head, n, call, call.stream);
  CudaBranch branch(call.stream);  // network and lines overlap with the space planes
  network_weight_gradient(net, data(f), data(h), v_hidden, v_head, mutable_data(network_gradient), n, call, branch.stream);
  field_rows(field.planes, field.lines, field.cells, data(b), v_features, r, mutable_data(v_raw), call.stream);
  branch.fork();
  line_gradient(field.planes, field.lines, field.cells, r, mutable_data(v_lines), call, branch.stream);
  sum_dense_cells(field.planes, field.cells, r, call.stream);
  call.finish("hexplane_train_backward");
  return {network_gradient, rows, fractions, dense_sums, v_lines};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("hexplane_train", GSPLAT_BOX(&hexplane_train));
  m.impl("hexplane_train_backward", GSPLAT_BOX(&hexplane_train_backward));
}

}  // namespace gsplat::hexplane
