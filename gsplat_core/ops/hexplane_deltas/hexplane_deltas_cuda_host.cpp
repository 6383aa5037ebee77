// Host code of hexplane_deltas: argument checks, memory and kernel launches.
#include "field_arguments.h"

namespace gsplat::hexplane {
namespace {

Tensor hexplane_deltas(std::vector<Tensor> spaces, Tensor coordinates, OptionalTensor order, Tensor time,
                       std::vector<Tensor> time_planes, std::vector<Tensor> weights, std::vector<Tensor> biases) {
  CudaCall call(coordinates);
  const Tensor points = aligned_floats(call, coordinates, "coordinates"), now = call.floats(time, "time");
  check(!spaces.empty() && spaces.size() <= size_t(kMaxFieldLevels) && time_planes.size() == 3 * spaces.size(),
        "hexplane_deltas takes 1 to ", kMaxFieldLevels, " levels with three time planes each, got ", spaces.size(),
        " spaces and ", time_planes.size(), " time planes");
  check(points.dim() == 2 && points.size(1) == 4 && now.numel() == 1, "coordinates must be [N, 4], and time one number");
  const int64_t n = points.size(0), channels = spaces[0].size(1);
  const bool half = spaces[0].scalar_type() == ScalarType::Half;
  FieldInput in = {};
  in.coordinates = data(points), in.count = n, in.channels = int32_t(channels), in.levels = int32_t(spaces.size());
  for (size_t l = 0; l < spaces.size(); ++l) {
    check(spaces[l].dim() == 2 && spaces[l].size(0) == n && spaces[l].size(1) == channels, "every space must be [", n, ", ",
          channels, "]");
    spaces[l] = half ? call.take(spaces[l], ScalarType::Half, "a space") : call.floats(spaces[l], "a space");
    if (reinterpret_cast<uintptr_t>(spaces[l].const_data_ptr()) % 16 != 0) spaces[l] = torch::stable::clone(spaces[l]);
    in.spaces[l] = spaces[l].const_data_ptr();
  }
  OptionalTensor places;
  if (order.has_value()) {
    places = call.ints(*order, "order");
    check(places->numel() == n, "order must have ", n, " entries");
    in.order = places->const_data_ptr<int32_t>();
  }
  FieldTimePlanes times = {};
  const int64_t size = lines_of(call, time_planes, channels, times, in.lines);
  const FieldNetwork net = network_of(call, weights, biases, channels * int64_t(spaces.size()));
  const int item = half ? 2 : 4;
  check(channels * item % 64 == 0 && net.fits(item), "hexplane_deltas takes a multiple of ", 64 / item,
        " channels, layers up to 128 wide, and weights that fit into ", kMaxPackedBytes, " bytes; got ", channels,
        " channels, width ", net.width, ", ", net.layers, " layers; use hexplane_decode");
  Tensor deltas = call.empty({n, kRawColumns});
  in.lines.values = call.bytes(size_t(size * item));
  void* packed = call.bytes(net.packed_bytes(item));
  prepare_field(times, in, data(now), &net, packed, half, call.stream);
  field_deltas(in, net, packed, half, mutable_data(deltas), nullptr, call.stream);
  call.finish("hexplane_deltas");
  return deltas;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) { m.impl("hexplane_deltas", GSPLAT_BOX(&hexplane_deltas)); }

}  // namespace gsplat::hexplane
