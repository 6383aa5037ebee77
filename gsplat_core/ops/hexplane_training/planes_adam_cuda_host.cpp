// Host code of the planes' gradient, and of Adam over planes and network: checks and launches.
#include "field_planes.h"

namespace gsplat::hexplane {
namespace {

// Return N from the rows of all slots; a level of six planes has three slots.
int64_t count_of(const Tensors& gradient, const Tensors& planes) {
  check(gradient.size() == 5, "gradient must be rows, fractions, dense sums, line gradient and starts, got ", gradient.size(),
        " tensors");
  check(gradient[0].dim() == 3 && planes.size() >= 6, "rows must be [2, items, C], and planes six per level");
  return gradient[0].size(1) / int64_t(planes.size() / 2);
}

// Gradient tensors returned by hexplane_train_backward, converted to arguments of the passes over the planes.
struct PlanesGradient {
  Tensor time, rows, fractions, dense_sums, v_lines, starts;
  FieldRows raw = {};

  PlanesGradient(const CudaCall& call, Field& field, const Tensor& time_in, const Tensors& gradient)
      : time(call.floats(time_in, "time")),
        rows(call.floats(gradient[0], "rows")),
        fractions(call.floats(gradient[1], "fractions")),
        dense_sums(call.floats(gradient[2], "dense sums")),
        v_lines(call.floats(gradient[3], "line gradient")),
        starts(call.ints(gradient[4], "starts")) {
    const int64_t values = 3 * field.planes.levels * field.cells.count;
    check(fractions.numel() == 2 * values && rows.numel() == 2 * values * field.planes.channels &&
              dense_sums.numel() == (values + 31) / 32 * 20 * field.planes.channels && starts.numel() == field.cells.cells + 1 &&
              v_lines.numel() == field.line_size && time.numel() == 1,
          "rows, fractions, dense sums, line gradient and starts must be those that hexplane_train_backward returned");
    field.cells.starts = const_cast<int32_t*>(starts.const_data_ptr<int32_t>());
    raw.space = const_cast<float*>(data(rows));
    raw.fractions = const_cast<float*>(data(fractions));
    raw.dense_sums = const_cast<float*>(data(dense_sums));
    raw.lines = raw.space + values * field.planes.channels;
  }
};

// Learning rate, step and status of an update. Their tensors must outlive this object.
struct UpdateOptions {
  Tensor rate, step;
  OptionalTensor status;
  PlanesAdam raw = {};

  UpdateOptions(const CudaCall& call, const Tensor& rate_, const Tensor& step_, const OptionalTensor& status_, double beta1,
                double beta2, double epsilon)
      : rate(call.floats(rate_, "rate")), step(call.take(step_, ScalarType::Long, "step")) {
    if (status_.has_value()) status = call.ints(*status_, "status");
    check(rate.numel() == 1 && step.numel() == 1 && (!status.has_value() || status->numel() >= 3),
          "rate and step must be one number each, and status four");
    raw = {data(rate),
           step.const_data_ptr<int64_t>(),
           status.has_value() ? status->const_data_ptr<int32_t>() : nullptr,
           beta1,
           beta2,
           epsilon,
           {}};
  }
};

Tensors hexplane_planes_gradient(Tensor time, Tensors gradient, Tensors planes) {
  const int64_t count = count_of(gradient, planes);
  CudaCall call(gradient[0]);
  Field field(call, planes, count);
  const PlanesGradient from(call, field, time, gradient);
  PlaneGradients gradients = {};
  Tensors out;
  for (size_t i = 0; i < planes.size(); ++i) {
    out.push_back(call.empty({planes[i].size(0), planes[i].size(1), planes[i].size(2)}));
    const size_t level = i / 6, p = i % 6;
    (p < 3 ? gradients.space[level][p] : gradients.time[level][p - 3]) = mutable_data(out.back());
    if (p >= 3) gradients.time_rows[level][p - 3] = int32_t(planes[i].size(0));
  }
  planes_gradient(field.planes, field.lines, field.cells, from.raw, data(from.v_lines), data(from.time), gradients, call.stream);
  call.finish("hexplane_planes_gradient");
  return out;
}

void hexplane_planes_adam_(Tensors planes, Tensors first, Tensors second, Tensor time, Tensors gradient, Tensor rate, Tensor step,
                           OptionalTensor status, double beta1, double beta2, double epsilon, double smoothness,
                           double time_smoothness, double sparsity) {
  const int64_t count = count_of(gradient, planes);
  CudaCall call(gradient[0]);
  Field field(call, planes, count);
  const PlanesGradient from(call, field, time, gradient);
  check(first.size() == planes.size() && second.size() == planes.size(), "every plane needs its two moments");
  PlanesState state = {};
  for (size_t i = 0; i < planes.size(); ++i) {
    for (const Tensor* moment : {&first[i], &second[i]}) {
      call.floats(*moment, "a moment");
      check(moment->is_contiguous() && moment->numel() == planes[i].numel(),
            "moments must be contiguous and of their plane's size");
    }
    const size_t level = i / 6, p = i % 6;
    auto& plane = p < 3 ? state.space[level][p] : state.time[level][p - 3];
    plane = {mutable_data(planes[i]), mutable_data(first[i]), mutable_data(second[i])};
    if (p >= 3) state.time_rows[level][p - 3] = int32_t(planes[i].size(0));
  }
  check(smoothness == 0 || field.planes.channels <= 512, "the penalty on space planes takes up to 512 channels, got ",
        field.planes.channels);
  UpdateOptions options(call, rate, step, status, beta1, beta2, epsilon);
  options.raw.penalties = {float(smoothness), float(time_smoothness), float(sparsity)};
  planes_adam(field.planes, field.lines, field.cells, from.raw, data(from.v_lines), data(from.time), state, options.raw, call,
              call.stream);
  call.finish("hexplane_planes_adam_");
}

void network_adam_(Tensors parameters, Tensor gradient, Tensor first, Tensor second, Tensor rate, Tensor step,
                   OptionalTensor status, double beta1, double beta2, double epsilon) {
  CudaCall call(gradient);
  const Tensor g = call.floats(gradient, "gradient");
  check(!parameters.empty() && parameters.size() <= size_t(2 * kMaxFieldLayers), "network_adam_ takes 1 to ", 2 * kMaxFieldLayers,
        " tensors, got ", parameters.size());
  NetworkParameters list = {};
  for (const Tensor& t : parameters) {
    call.floats(t, "a parameter");
    check(t.is_contiguous(), "network_adam_ updates contiguous tensors in place");
    list.values[list.count] = mutable_data(t);
    list.starts[list.count + 1] = list.starts[list.count] + int32_t(t.numel());
    ++list.count;
  }
  for (const Tensor* t : {&g, static_cast<const Tensor*>(&first), static_cast<const Tensor*>(&second)}) {
    call.floats(*t, "gradient and moments");
    check(t->is_contiguous() && t->numel() == list.starts[list.count],
          "gradient and moments must be contiguous, with the parameters one after the other: ", list.starts[list.count],
          " values");
  }
  const UpdateOptions options(call, rate, step, status, beta1, beta2, epsilon);
  network_adam(list, data(g), mutable_data(first), mutable_data(second), options.raw, call.stream);
  call.finish("network_adam_");
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("hexplane_planes_gradient", GSPLAT_BOX(&hexplane_planes_gradient));
  m.impl("hexplane_planes_adam_", GSPLAT_BOX(&hexplane_planes_adam_));
  m.impl("network_adam_", GSPLAT_BOX(&network_adam_));
}

}  // namespace gsplat::hexplane
