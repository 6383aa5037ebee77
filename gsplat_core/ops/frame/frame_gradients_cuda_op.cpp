#include <cstdint>
#include <optional>
#include <tuple>

#include "frame_gradients_cuda.h"
#include "frame_scene.h"

namespace {

using OptionalTensor = std::optional<Tensor>;

bool starts_on_quad(const Tensor& t) { return reinterpret_cast<uintptr_t>(t.const_data_ptr()) % 16 == 0; }

// What the forward pass left and what came back from the picture, checked, and how the kernels see them.
struct FramePass {
  Tensor records, tile_offsets, sorted, splat_starts, instance_splats, status, alphas, last, v_image;
  OptionalTensor v_alphas;
  FrameLists lists;
  FrameGradients from;

  FramePass(FrameInputs& inputs, const Tensor& records_in, const Tensor& tile_offsets_in, const Tensor& sorted_in,
            const Tensor& splat_starts_in, const Tensor& instance_splats_in, const Tensor& status_in, const Tensor& alphas_in,
            const Tensor& last_in, const Tensor& v_image_in, const OptionalTensor& v_alphas_in, bool deterministic)
      : records(floats(inputs, records_in, 4 * kRowQuads * inputs.scene.count, "records")),
        tile_offsets(ints(inputs, tile_offsets_in, inputs.scene.tiles() + 1, "tile_offsets")),
        sorted(ints(inputs, sorted_in, sorted_in.numel(), "sorted")),
        splat_starts(ints(inputs, splat_starts_in, inputs.scene.count + 1, "splat_starts")),
        instance_splats(ints(inputs, instance_splats_in, sorted.numel(), "instance_splats")),
        status(ints(inputs, status_in, 4, "status")),
        alphas(floats(inputs, alphas_in, pixels(inputs), "alphas")),
        last(ints(inputs, last_in, pixels(inputs), "last")),
        v_image(floats(inputs, v_image_in, 4 * pixels(inputs), "v_image")) {
    if (v_alphas_in) v_alphas = floats(inputs, *v_alphas_in, pixels(inputs), "v_alphas");
    const auto pointer = [](const Tensor& t) { return const_cast<int32_t*>(t.const_data_ptr<int32_t>()); };
    lists = {.records = const_cast<float*>(data(records)),
             .tile_offsets = pointer(tile_offsets),
             .sorted = pointer(sorted),
             .splat_starts = pointer(splat_starts),
             .instance_splats = pointer(instance_splats),
             .status = pointer(status),
             .capacity = sorted.numel()};
    from = {data(v_image),
            v_alphas ? data(*v_alphas) : nullptr,
            data(alphas),
            pointer(last),
            inputs.call.array<float4>((deterministic ? lists.capacity : inputs.scene.count) * kRowQuads),
            !deterministic};
  }

  static int64_t pixels(const FrameInputs& inputs) { return int64_t(inputs.scene.width) * inputs.scene.height; }

 private:
  static Tensor sized(const Tensor& t, int64_t count, const char* name) {
    check(t.numel() == count, "render_frame_backward: ", name, " must have ", count,
          " values for this frame, as render_frame gives with training=True; got ", t.numel());
    return t;
  }
  // The kernels read whole float4s.
  static Tensor floats(const FrameInputs& inputs, const Tensor& t, int64_t count, const char* name) {
    const Tensor taken = inputs.call.floats(sized(t, count, name), name);
    return starts_on_quad(taken) ? taken : torch::stable::clone(taken);
  }
  static Tensor ints(const FrameInputs& inputs, const Tensor& t, int64_t count, const char* name) {
    return inputs.call.ints(sized(t, count, name), name);
  }
};

// A tensor that is updated in place, of `count` values.
float* updated(const CudaCall& call, Tensor& t, int64_t count, const char* name) {
  call.floats(t, name);
  check(t.numel() == count, "render_frame_backward_adam_: ", name, " must have ", count, " values, got ", t.numel());
  check(t.is_contiguous() && starts_on_quad(t), "render_frame_backward_adam_: ", name,
        " is updated in place and must be contiguous and start at a multiple of 16 bytes; give it memory of its own");
  return mutable_data(t);
}

std::tuple<Tensor, Tensor> render_frame_backward(Tensor means, Tensor quats, Tensor log_scales, Tensor logit_opacities, Tensor sh,
                                                 OptionalTensor deltas, Tensor viewmat, Tensor intrinsics,
                                                 OptionalTensor background, Tensor records, Tensor tile_offsets, Tensor sorted,
                                                 Tensor splat_starts, Tensor instance_splats, Tensor status, Tensor alphas,
                                                 Tensor last, Tensor v_image, OptionalTensor v_alphas, int64_t width,
                                                 int64_t height, double eps2d, int64_t camera_model, bool deterministic) {
  FrameInputs inputs(means, quats, log_scales, logit_opacities, sh, deltas, viewmat, intrinsics, background, width, height, eps2d,
                     0, 0, camera_model);
  const FramePass pass(inputs, records, tile_offsets, sorted, splat_starts, instance_splats, status, alphas, last, v_image,
                       v_alphas, deterministic);
  const CudaCall& call = inputs.call;
  const FrameScene& scene = inputs.scene;
  const int64_t n = scene.count, bases = scene.bases;
  Tensor v_raw = call.empty({n, kRawColumns}), v_sh = bases > 1 ? call.empty({n, bases, 3}) : call.empty({0});
  instance_gradients_on_device(scene, pass.lists, pass.from, call.stream);
  splat_gradients_on_device(scene, pass.lists, pass.from, {mutable_data(v_raw), bases > 1 ? mutable_data(v_sh) : nullptr},
                            call.stream);
  check_cuda(cudaGetLastError(), "render_frame_backward");
  return {v_raw, v_sh};
}

Tensor render_frame_backward_adam_(Tensor means, Tensor quats, Tensor log_scales, Tensor logit_opacities, Tensor sh,
                                   OptionalTensor deltas, Tensor viewmat, Tensor intrinsics, OptionalTensor background,
                                   Tensor records, Tensor tile_offsets, Tensor sorted, Tensor splat_starts,
                                   Tensor instance_splats, Tensor status, Tensor alphas, Tensor last, Tensor v_image,
                                   OptionalTensor v_alphas, Tensor m_means, Tensor m_quats, Tensor m_log_scales,
                                   Tensor m_logit_opacities, Tensor m_sh, Tensor v_means, Tensor v_quats, Tensor v_log_scales,
                                   Tensor v_logit_opacities, Tensor v_sh, Tensor rates, Tensor step, Tensor skipped,
                                   int64_t width, int64_t height, double eps2d, int64_t camera_model, double beta1, double beta2,
                                   double epsilon, bool needs_raw, bool deterministic) {
  FrameInputs inputs(means, quats, log_scales, logit_opacities, sh, deltas, viewmat, intrinsics, background, width, height, eps2d,
                     0, 0, camera_model);
  const FramePass pass(inputs, records, tile_offsets, sorted, splat_starts, instance_splats, status, alphas, last, v_image,
                       v_alphas, deterministic);
  const CudaCall& call = inputs.call;
  const FrameScene& scene = inputs.scene;
  const int64_t n = scene.count;
  FrameAdam adam = {};
  Tensor* const parameters[] = {&means, &quats, &log_scales, &logit_opacities, &sh};
  Tensor* const first[] = {&m_means, &m_quats, &m_log_scales, &m_logit_opacities, &m_sh};
  Tensor* const second[] = {&v_means, &v_quats, &v_log_scales, &v_logit_opacities, &v_sh};
  for (int i = 0; i < kRateCount; ++i) {
    const int64_t values = parameters[i]->numel();
    adam.parameters[i] = updated(call, *parameters[i], values, "a parameter");
    adam.first[i] = updated(call, *first[i], values, "a first moment");
    adam.second[i] = updated(call, *second[i], values, "a second moment");
  }
  call.take(skipped, ScalarType::Long, "skipped");
  check(skipped.is_contiguous() && skipped.numel() == kRateCount, "skipped must be contiguous, with 5 counts");
  adam.step_is_long = step.scalar_type() == ScalarType::Long;
  const Tensor rates_of_step = call.floats(rates, "rates"),
               step_number = call.take(step, adam.step_is_long ? ScalarType::Long : ScalarType::Int, "step");
  check(rates.numel() == kRateCount && step.numel() == 1, "rates must have 5 values and step one");
  adam.rates = data(rates_of_step);
  adam.step = step_number.const_data_ptr();
  adam.beta1 = beta1;
  adam.beta2 = beta2;
  adam.epsilon = float(epsilon);
  adam.skipped = reinterpret_cast<unsigned long long*>(skipped.mutable_data_ptr<int64_t>());
  Tensor v_raw = needs_raw ? call.empty({n, kRawColumns}) : call.empty({0});
  instance_gradients_on_device(scene, pass.lists, pass.from, call.stream);
  splat_gradients_adam_on_device(scene, pass.lists, pass.from, {needs_raw ? mutable_data(v_raw) : nullptr, nullptr}, adam,
                                 call.stream);
  check_cuda(cudaGetLastError(), "render_frame_backward_adam_");
  return v_raw;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("render_frame_backward", GSPLAT_BOX(&render_frame_backward));
  m.impl("render_frame_backward_adam_", GSPLAT_BOX(&render_frame_backward_adam_));
}
