// Host code of ray_depth_loss and ray_normal_loss: checks, memory, and the passes on each device.
#include "ray_losses.h"

#include <tuple>

#include "host_call.h"

namespace gsplat::ray_losses {
namespace {

#if defined(GSPLAT_CUDA)

void run(Call& call, const DepthLoss& loss, float* value) { depth_loss_on_device(loss, value, call, call.stream); }
void run(Call& call, const NormalLoss& loss, float* value) { normal_loss_on_device(loss, value, call, call.stream); }

#else

constexpr int64_t kRows = 16;  // minimum rows per task

// Run the forward and the backward pass of a loss. Sums of rows are added in row order, independent of the thread that
// computed each row.
template <class Loss>
void run_passes(Call& call, const Loss& loss, double least_divisor, float* value,
                void (*terms)(const Loss&, Sums*, int64_t, int64_t), void (*gradients)(const Loss&, float, int64_t, int64_t)) {
  Sums* const rows = call.array<Sums>(loss.height);
  torch::stable::parallel_for(0, loss.height, kRows, [&](int64_t begin, int64_t end) { terms(loss, rows, begin, end); });
  Sums total = {0, 0};
  for (int64_t y = 0; y < loss.height; ++y) total.terms += rows[y].terms, total.divisor += rows[y].divisor;
  const double factor = 1 / (total.divisor > least_divisor ? total.divisor : least_divisor);
  *value = float(total.terms * factor);
  torch::stable::parallel_for(0, loss.height, kRows,
                              [&](int64_t begin, int64_t end) { gradients(loss, float(factor), begin, end); });
}

void run(Call& call, const DepthLoss& loss, float* value) {
  run_passes(call, loss, kLeastInverse, value, kernels().depth_terms, kernels().depth_gradients);
}
void run(Call& call, const NormalLoss& loss, float* value) {
  run_passes(call, loss, 1, value, kernels().normal_terms, kernels().normal_gradients);
}

#endif

constexpr int64_t kMostPixels = (int64_t(1) << 31) - 1;

void check_planes(const char* op, const Tensor& depths) {
  check(depths.dim() == 2 && depths.numel() <= kMostPixels, op, ": depths must be [H, W] with fewer than 2^31 pixels");
}

std::tuple<Tensor, Tensor> ray_depth_loss(Tensor depths, Tensor known, Tensor tissue) {
  Call call(depths);
  const Tensor depths_ = call.floats(depths, "depths"), known_ = call.floats(known, "known");
  const Tensor tissue_ = call.take(tissue, ScalarType::Byte, "tissue");
  check_planes("ray_depth_loss", depths_);
  check(known_.numel() == depths_.numel() && tissue_.numel() == depths_.numel(),
        "ray_depth_loss: known and tissue must have the size of depths, ", depths_.numel(), " pixels, got ", known_.numel(),
        " and ", tissue_.numel());
  const int64_t height = depths_.size(0), width = depths_.size(1);
  Tensor value = call.empty({}), v_depths = call.empty({height, width});
  run(call,
      DepthLoss{data(depths_), data(known_), tissue_.const_data_ptr<uint8_t>(), int32_t(height), int32_t(width),
                mutable_data(v_depths)},
      mutable_data(value));
  call.finish("ray_depth_loss");
  return {value, v_depths};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> ray_normal_loss(Tensor depths, Tensor alphas, Tensor normals, Tensor tissue, Tensor K,
                                                           int64_t camera_model) {
  Call call(depths);
  const Tensor depths_ = call.floats(depths, "depths"), alphas_ = call.floats(alphas, "alphas");
  const Tensor normals_ = call.floats(normals, "normals"), K_ = call.floats(K, "K");
  const Tensor tissue_ = call.take(tissue, ScalarType::Byte, "tissue");
  check_planes("ray_normal_loss", depths_);
  const int64_t height = depths_.size(0), width = depths_.size(1), pixels = height * width;
  check(alphas_.numel() == pixels && normals_.numel() == 3 * pixels && tissue_.numel() == pixels,
        "ray_normal_loss: alphas, normals and tissue must have the size of depths, ", pixels, " pixels, got ", alphas_.numel(),
        ", ", normals_.numel(), " / 3 and ", tissue_.numel());
  check(K_.numel() == 9 && camera_model >= kPinhole && camera_model <= kFisheye,
        "ray_normal_loss: K must be [3, 3] and the camera model 0 to 2, got ", K_.numel(), " values and model ", camera_model);
  Tensor value = call.empty({}), v_depths = call.empty({height, width}), v_alphas = call.empty({height, width});
  Tensor v_normals = call.empty({height, width, 3});
  run(call,
      NormalLoss{.depths = data(depths_),
                 .alphas = data(alphas_),
                 .normals = data(normals_),
                 .tissue = tissue_.const_data_ptr<uint8_t>(),
                 .K = data(K_),
                 .height = int32_t(height),
                 .width = int32_t(width),
                 .camera_model = int32_t(camera_model),
                 .changes = call.array<float>(4 * pixels),
                 .bits = call.array<uint8_t>(pixels),
                 .v_depths = mutable_data(v_depths),
                 .v_alphas = mutable_data(v_alphas),
                 .v_normals = mutable_data(v_normals)},
      mutable_data(value));
  call.finish("ray_normal_loss");
  return {value, v_depths, v_alphas, v_normals};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("ray_depth_loss", GSPLAT_BOX(&ray_depth_loss));
  m.impl("ray_normal_loss", GSPLAT_BOX(&ray_normal_loss));
}

}  // namespace gsplat::ray_losses
