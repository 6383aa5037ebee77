#include <cstdint>
#include <optional>
#include <tuple>

#include "cuda_call.h"
#include "frame_gradients_cuda.h"

namespace {

using OptionalTensor = std::optional<Tensor>;

bool aligned(const Tensor& t) { return reinterpret_cast<uintptr_t>(t.const_data_ptr()) % 16 == 0; }

// The frame's inputs and what its forward pass left, checked; and how the kernels see them.
class FrameBackward {
 public:
  FrameScene scene = {};
  FrameLists lists = {};
  FrameGradients from = {};

  explicit FrameBackward(CudaCall& call) : call_(call) {}

  void gaussians(const Tensor& means, const Tensor& quats, const Tensor& log_scales, const Tensor& logit_opacities,
                 const Tensor& sh, const OptionalTensor& deltas) {
    STD_TORCH_CHECK(means.dim() == 2 && means.size(1) == 3 && sh.dim() == 3 && sh.size(2) == 3,
                    "render_frame's gradient takes means [N, 3] and sh [N, K, 3]");
    const int64_t n = scene.count = means.size(0);
    scene.bases = int32_t(sh.size(1));
    while (scene.sh_degree < 4 && (scene.sh_degree + 1) * (scene.sh_degree + 1) < scene.bases) ++scene.sh_degree;
    STD_TORCH_CHECK((scene.sh_degree + 1) * (scene.sh_degree + 1) == scene.bases,
                    "render_frame's gradient takes sh with 1, 4, 9, 16 or 25 bases, got ", scene.bases);
    scene.means = floats(means, 3 * n, "means");
    scene.quats = floats(quats, 4 * n, "quats");
    scene.log_scales = floats(log_scales, 3 * n, "log_scales");
    scene.logit_opacities = floats(logit_opacities, n, "logit_opacities");
    scene.sh = floats(sh, 3 * n * scene.bases, "sh");
    if (deltas.has_value()) scene.deltas = floats(*deltas, kRawColumns * n, "deltas");
  }

  void camera(const Tensor& viewmat, const Tensor& intrinsics, const OptionalTensor& background, int64_t width, int64_t height,
              double eps2d, int64_t model) {
    STD_TORCH_CHECK(width >= 0 && height >= 0 && width < 1 << 20 && height < 1 << 20, "the image cannot have ", width, " x ",
                    height, " pixels");
    scene.width = int32_t(width);
    scene.height = int32_t(height);
    scene.tile_width = int32_t((width + kFrameTile - 1) / kFrameTile);
    scene.tile_height = int32_t((height + kFrameTile - 1) / kFrameTile);
    scene.eps2d = float(eps2d);
    scene.camera_model = int32_t(model);
    scene.viewmat = floats(viewmat, 16, "viewmat");
    scene.intrinsics = floats(intrinsics, 9, "K");
    if (background.has_value()) scene.background = floats(*background, 3, "background");
  }

  void forward_pass(const Tensor& records, const Tensor& tile_offsets, const Tensor& sorted, const Tensor& splat_starts,
                    const Tensor& instance_splats, const Tensor& status) {
    lists.records = const_cast<float*>(floats(records, 4 * kRowQuads * scene.count, "records"));
    lists.tile_offsets = ints(tile_offsets, scene.tiles() + 1, "tile_offsets");
    lists.capacity = sorted.numel();
    lists.sorted = ints(sorted, lists.capacity, "sorted");
    lists.instance_splats = ints(instance_splats, lists.capacity, "instance_splats");
    lists.splat_starts = ints(splat_starts, scene.count + 1, "splat_starts");
    lists.status = ints(status, 4, "status");
  }

  void picture(const Tensor& alphas, const Tensor& last, const Tensor& v_image, const OptionalTensor& v_alphas) {
    const int64_t pixels = int64_t(scene.width) * scene.height;
    from.alphas = floats(alphas, pixels, "alphas");
    from.last = ints(last, pixels, "last");
    from.v_image = floats(v_image, 4 * pixels, "v_image");
    if (v_alphas.has_value()) from.v_alphas = floats(*v_alphas, pixels, "v_alphas");
    from.rows = call_.array<float4>(lists.capacity * kRowQuads);
  }

  // A tensor that is updated in place, of `count` values.
  float* updated(Tensor& t, int64_t count, const char* name) const {
    call_.floats(t, name);
    STD_TORCH_CHECK(t.numel() == count, name, " must have ", count, " values, got ", t.numel());
    STD_TORCH_CHECK(t.is_contiguous() && aligned(t), name,
                    " is updated in place and must be contiguous and start at a multiple of 16 bytes; give it memory of its own");
    return mutable_data(t);
  }

 private:
  // A contiguous copy where a tensor is not so already; with `wide` loads in mind also where it starts between 16 bytes.
  const float* floats(const Tensor& t, int64_t count, const char* name) {
    STD_TORCH_CHECK(t.numel() == count, name, " must have ", count, " values, got ", t.numel());
    Tensor taken = call_.floats(t, name);
    kept_.push_back(aligned(taken) ? taken : torch::stable::clone(taken));
    return data(kept_.back());
  }
  int32_t* ints(const Tensor& t, int64_t count, const char* name) {
    STD_TORCH_CHECK(t.numel() == count, name, " must have ", count, " values, got ", t.numel());
    kept_.push_back(call_.ints(t, name));
    return const_cast<int32_t*>(kept_.back().const_data_ptr<int32_t>());
  }

  CudaCall& call_;
  std::vector<Tensor> kept_;
};

std::tuple<Tensor, Tensor> render_frame_backward(Tensor means, Tensor quats, Tensor log_scales, Tensor logit_opacities, Tensor sh,
                                                 OptionalTensor deltas, Tensor viewmat, Tensor intrinsics,
                                                 OptionalTensor background, Tensor records, Tensor tile_offsets, Tensor sorted,
                                                 Tensor splat_starts, Tensor instance_splats, Tensor status, Tensor alphas,
                                                 Tensor last, Tensor v_image, OptionalTensor v_alphas, int64_t width,
                                                 int64_t height, double eps2d, int64_t camera_model) {
  CudaCall call(means);
  FrameBackward frame(call);
  frame.gaussians(means, quats, log_scales, logit_opacities, sh, deltas);
  frame.camera(viewmat, intrinsics, background, width, height, eps2d, camera_model);
  frame.forward_pass(records, tile_offsets, sorted, splat_starts, instance_splats, status);
  frame.picture(alphas, last, v_image, v_alphas);
  const int64_t n = frame.scene.count, bases = frame.scene.bases;
  Tensor v_raw = call.empty({n, kRawColumns}), v_sh = bases > 1 ? call.empty({n, bases, 3}) : call.empty({0});
  instance_gradients_on_device(frame.scene, frame.lists, frame.from, call.stream);
  splat_gradients_on_device(frame.scene, frame.lists, frame.from, {mutable_data(v_raw), bases > 1 ? mutable_data(v_sh) : nullptr},
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
                                   double epsilon, bool needs_raw) {
  CudaCall call(means);
  FrameBackward frame(call);
  frame.gaussians(means, quats, log_scales, logit_opacities, sh, deltas);
  frame.camera(viewmat, intrinsics, background, width, height, eps2d, camera_model);
  frame.forward_pass(records, tile_offsets, sorted, splat_starts, instance_splats, status);
  frame.picture(alphas, last, v_image, v_alphas);
  const int64_t n = frame.scene.count;
  FrameAdam adam = {};
  Tensor* const parameters[] = {&means, &quats, &log_scales, &logit_opacities, &sh};
  Tensor* const first[] = {&m_means, &m_quats, &m_log_scales, &m_logit_opacities, &m_sh};
  Tensor* const second[] = {&v_means, &v_quats, &v_log_scales, &v_logit_opacities, &v_sh};
  for (int i = 0; i < kRateCount; ++i) {
    const int64_t values = parameters[i]->numel();
    adam.parameters[i] = frame.updated(*parameters[i], values, "a parameter");
    adam.first[i] = frame.updated(*first[i], values, "a first moment");
    adam.second[i] = frame.updated(*second[i], values, "a second moment");
  }
  call.take(skipped, ScalarType::Long, "skipped");
  STD_TORCH_CHECK(skipped.is_contiguous() && skipped.numel() == kRateCount, "skipped must be contiguous, with 5 counts");
  adam.step_is_long = step.scalar_type() == ScalarType::Long;
  const Tensor rates_of_step = call.floats(rates, "rates"),
               step_number = call.take(step, adam.step_is_long ? ScalarType::Long : ScalarType::Int, "step");
  STD_TORCH_CHECK(rates.numel() == kRateCount && step.numel() == 1, "rates must have 5 values and step one");
  adam.rates = data(rates_of_step);
  adam.step = step_number.const_data_ptr();
  adam.beta1 = beta1;
  adam.beta2 = beta2;
  adam.epsilon = float(epsilon);
  adam.skipped = reinterpret_cast<unsigned long long*>(skipped.mutable_data_ptr<int64_t>());
  Tensor v_raw = needs_raw ? call.empty({n, kRawColumns}) : call.empty({0});
  instance_gradients_on_device(frame.scene, frame.lists, frame.from, call.stream);
  splat_gradients_adam_on_device(frame.scene, frame.lists, frame.from, {needs_raw ? mutable_data(v_raw) : nullptr, nullptr}, adam,
                                 call.stream);
  check_cuda(cudaGetLastError(), "render_frame_backward_adam_");
  return v_raw;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("render_frame_backward", TORCH_BOX(&render_frame_backward));
  m.impl("render_frame_backward_adam_", TORCH_BOX(&render_frame_backward_adam_));
}
