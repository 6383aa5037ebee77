// Host code of render_frame_backward and render_frame_backward_adam_: argument checks, memory and kernel launches.
#include <cstdint>
#include <tuple>

#include "../frame/frame_inputs.h"
#include "frame_gradients.h"

namespace gsplat::frame {
namespace {

using Tensors = std::vector<Tensor>;

// Order of render_frame's results after the image.
enum Forward { kAlphas, kLast, kRecords, kTileOffsets, kSorted, kSplatStarts, kInstanceSplats, kStatus, kForwardTensors };

bool is_quad_aligned(const Tensor& t) { return reinterpret_cast<uintptr_t>(t.const_data_ptr()) % 16 == 0; }

ViewArguments view_of(const Tensor& v_image, double eps2d, int64_t camera_model) {
  check(v_image.dim() == 3 && v_image.size(2) == 4, "render_frame_backward: v_image must be [H, W, 4], got ", v_image.dim(),
        " dimensions and ", v_image.numel(), " values");
  return {v_image.size(1), v_image.size(0), eps2d, 0, 0, camera_model};
}

// Checked forward results and image gradient, converted to kernel arguments.
struct Backward {
  Tensor alphas, last, records, tile_offsets, sorted, splat_starts, instance_splats, status, v_image;
  OptionalTensor v_alphas, residuals, relaxation, added;
  Lists lists;
  PictureGradient from;

  Backward(Inputs& inputs, const Tensors& forward, const Tensor& v_image_in, const OptionalTensor& v_alphas_in,
           bool deterministic) {
    check(forward.size() == kForwardTensors, "render_frame_backward: forward must be the ", int(kForwardTensors),
          " results of render_frame after the image, got ", forward.size());
    const Scene& scene = inputs.scene;
    const int64_t pixels = int64_t(scene.width) * scene.height;
    alphas = floats(inputs, forward[kAlphas], pixels, "alphas");
    last = ints(inputs, forward[kLast], pixels, "last");
    records = floats(inputs, forward[kRecords], 4 * kRowQuads * scene.count, "records");
    tile_offsets = ints(inputs, forward[kTileOffsets], scene.tiles() + 1, "tile_offsets");
    sorted = ints(inputs, forward[kSorted], forward[kSorted].numel(), "sorted");
    splat_starts = ints(inputs, forward[kSplatStarts], scene.count + 1, "splat_starts");
    instance_splats = ints(inputs, forward[kInstanceSplats], sorted.numel(), "instance_splats");
    status = ints(inputs, forward[kStatus], kStatusSize, "status");
    v_image = floats(inputs, v_image_in, 4 * pixels, "v_image");
    if (v_alphas_in) v_alphas = floats(inputs, *v_alphas_in, pixels, "v_alphas");
    const auto pointer = [](const Tensor& t) { return const_cast<int32_t*>(t.const_data_ptr<int32_t>()); };
    lists = {.records = const_cast<float*>(data(records)),
             .tile_offsets = pointer(tile_offsets),
             .sorted = pointer(sorted),
             .splat_starts = pointer(splat_starts),
             .instance_splats = pointer(instance_splats),
             .status = pointer(status),
             .capacity = sorted.numel()};
    from = {.v_image = data(v_image),
            .v_alphas = v_alphas ? data(*v_alphas) : nullptr,
            .alphas = data(alphas),
            .last = pointer(last),
            .rows = inputs.call.array<float4>((deterministic ? lists.capacity : scene.count) * kRowQuads),
            .atomic = !deterministic,
            .correction = {},
            .added = nullptr};
  }

  // Enable colour corrections by `residuals`, if given.
  void correct(const Inputs& inputs, const OptionalTensor& residuals_in, const OptionalTensor& relaxation_in) {
    if (!residuals_in) return;
    const Scene& scene = inputs.scene;
    check(bool(relaxation_in) && scene.bases == 1,
          "render_frame_backward_adam_: residuals go with a relaxation and with harmonics of degree 0");
    residuals = floats(inputs, *residuals_in, 4 * int64_t(scene.width) * scene.height, "residuals");
    relaxation = inputs.call.floats(*relaxation_in, "relaxation");
    check(relaxation->numel() == 1, "relaxation must be one float32, got ", relaxation->numel());
    from.correction = {data(*residuals), data(*relaxation)};
  }

  // Add the gradient of further losses, if given.
  void add(const Inputs& inputs, const OptionalTensor& added_in) {
    if (!added_in) return;
    added = floats(inputs, *added_in, kRawColumns * inputs.scene.count, "added");
    from.added = data(*added);
  }

 private:
  static const Tensor& sized(const Tensor& t, int64_t count, const char* name) {
    check(t.numel() == count, "render_frame_backward: ", name, " must have ", count,
          " values for this frame, as render_frame returns it when training; got ", t.numel());
    return t;
  }
  // Return a tensor aligned to 16 bytes, because the kernels read whole float4s.
  static Tensor floats(const Inputs& inputs, const Tensor& t, int64_t count, const char* name) {
    const Tensor taken = inputs.call.floats(sized(t, count, name), name);
    return is_quad_aligned(taken) ? taken : torch::stable::clone(taken);
  }
  static Tensor ints(const Inputs& inputs, const Tensor& t, int64_t count, const char* name) {
    return inputs.call.ints(sized(t, count, name), name);
  }
};

// Return the data of a tensor of `count` values that is updated in place.
float* updated(const CudaCall& call, const Tensor& t, int64_t count, const char* name) {
  call.floats(t, name);
  check(t.numel() == count, "render_frame_backward_adam_: ", name, " must have ", count, " values, got ", t.numel());
  check(t.is_contiguous() && is_quad_aligned(t), "render_frame_backward_adam_: ", name,
        " is updated in place and must be contiguous and aligned to 16 bytes; give it memory of its own");
  return mutable_data(t);
}

std::tuple<Tensor, Tensor> render_frame_backward(Tensors gaussians, OptionalTensor deltas, Tensor viewmat, Tensor intrinsics,
                                                 OptionalTensor background, Tensors forward, Tensor v_image,
                                                 OptionalTensor v_alphas, double eps2d, int64_t camera_model,
                                                 bool deterministic) {
  Inputs inputs(gaussians, deltas, viewmat, intrinsics, background, view_of(v_image, eps2d, camera_model));
  const Backward pass(inputs, forward, v_image, v_alphas, deterministic);
  const CudaCall& call = inputs.call;
  const Scene& scene = inputs.scene;
  const int64_t n = scene.count, bases = scene.bases;
  Tensor v_raw = call.empty({n, kRawColumns}), v_sh = bases > 1 ? call.empty({n, bases, 3}) : call.empty({0});
  tile_gradients(scene, pass.lists, pass.from, call.stream);
  splat_gradients(scene, pass.lists, pass.from, {mutable_data(v_raw), bases > 1 ? mutable_data(v_sh) : nullptr}, call.stream);
  call.finish("render_frame_backward");
  return {v_raw, v_sh};
}

Tensor render_frame_backward_adam_(Tensors gaussians, Tensors first, Tensors second, Tensor rates, Tensor step, Tensor skipped,
                                   OptionalTensor deltas, Tensor viewmat, Tensor intrinsics, OptionalTensor background,
                                   Tensors forward, Tensor v_image, OptionalTensor v_alphas, OptionalTensor residuals,
                                   OptionalTensor relaxation, OptionalTensor added, double eps2d, int64_t camera_model,
                                   double beta1, double beta2, double epsilon, bool needs_raw, bool deterministic) {
  Inputs inputs(gaussians, deltas, viewmat, intrinsics, background, view_of(v_image, eps2d, camera_model));
  Backward pass(inputs, forward, v_image, v_alphas, deterministic);
  pass.correct(inputs, residuals, relaxation);
  pass.add(inputs, added);
  const CudaCall& call = inputs.call;
  check(first.size() == kTensors && second.size() == kTensors, "render_frame_backward_adam_: there must be ", kTensors,
        " first and second moments, got ", first.size(), " and ", second.size());
  Adam adam = {};
  for (size_t i = 0; i < kTensors; ++i) {
    const int64_t values = gaussians[i].numel();
    adam.parameters[i] = updated(call, gaussians[i], values, kGaussianTensors[i]);
    adam.first[i] = updated(call, first[i], values, "a first moment");
    adam.second[i] = updated(call, second[i], values, "a second moment");
  }
  call.take(skipped, ScalarType::Long, "skipped");
  check(skipped.is_contiguous() && skipped.numel() == kTensors, "skipped must be contiguous, with ", kTensors, " counts");
  adam.step_is_long = step.scalar_type() == ScalarType::Long;
  const Tensor rates_taken = call.floats(rates, "rates"),
               step_taken = call.take(step, adam.step_is_long ? ScalarType::Long : ScalarType::Int, "step");
  check(rates.numel() == kTensors && step.numel() == 1, "rates must have ", kTensors, " values and step one, got ", rates.numel(),
        " and ", step.numel());
  adam.rates = data(rates_taken);
  adam.step = step_taken.const_data_ptr();
  adam.beta1 = beta1;
  adam.beta2 = beta2;
  adam.epsilon = float(epsilon);
  adam.skipped = reinterpret_cast<unsigned long long*>(skipped.mutable_data_ptr<int64_t>());
  Tensor v_raw = needs_raw ? call.empty({inputs.scene.count, kRawColumns}) : call.empty({0});
  tile_gradients(inputs.scene, pass.lists, pass.from, call.stream);
  splat_adam(inputs.scene, pass.lists, pass.from, {needs_raw ? mutable_data(v_raw) : nullptr, nullptr}, adam, call.stream);
  call.finish("render_frame_backward_adam_");
  return v_raw;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("render_frame_backward", GSPLAT_BOX(&render_frame_backward));
  m.impl("render_frame_backward_adam_", GSPLAT_BOX(&render_frame_backward_adam_));
}

}  // namespace gsplat::frame
