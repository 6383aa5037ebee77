// Gradient of `rasterize`, in two calls: from the image to the splats, and from the splats to the inputs. The split
// exposes the gradient of means2d, which densification strategies read.
#include <tuple>

#include "scene_inputs.h"

namespace gsplat::rasterization {
namespace {

Sizes sizes_of(const Tensor& t) {
  Sizes sizes(size_t(t.dim()));
  for (size_t i = 0; i < sizes.size(); ++i) sizes[i] = t.size(int64_t(i));
  return sizes;
}

// Indices of the tensors that the forward pass saves for the gradient. `Saved` in __init__.py has the same order.
enum SavedTensor { kRecords, kConics, kOffsets, kSplatIds, kSorted, kStarts, kRowOf, kBehind, kAlphas, kExpected, kLast, kSaved };

// Return the gradients of the splats' records and of means2d, and the sums of |dL/dmeans2d|, which are empty unless
// requested.
std::tuple<Tensor, Tensor, Tensor> rasterize_splats_backward(OptionalTensors saved, OptionalTensor v_image_in,
                                                             OptionalTensor v_alphas_in, std::vector<int64_t> image_dims,
                                                             std::vector<int64_t> options, std::vector<double> ranges) {
  check(saved.size() == kSaved && saved[kRecords].has_value(), "rasterize_splats_backward takes ", int(kSaved), " tensors");
  const Tensor records = *saved[kRecords];
  const CudaCall call(records);
  const Request size(image_dims, options, ranges);
  for (const SavedTensor i : {kConics, kOffsets, kSplatIds, kSorted, kStarts, kAlphas, kLast})
    check(saved[i].has_value(), "rasterize_splats_backward: tensor ", int(i), " is missing");
  const Tensor conics = call.floats(*saved[kConics], "conics"), alphas = call.floats(*saved[kAlphas], "alphas");
  const Tensor isect_offsets = call.ints(*saved[kOffsets], "isect_offsets"),
               splat_ids = call.ints(*saved[kSplatIds], "splat_ids"), sorted = call.ints(*saved[kSorted], "sorted"),
               splat_starts = call.ints(*saved[kStarts], "splat_starts"), last = call.ints(*saved[kLast], "last");
  const OptionalTensor row_of = call.ints(saved[kRowOf], "row_of"), backgrounds = call.floats(saved[kBehind], "backgrounds"),
                       expected = call.floats(saved[kExpected], "expected"), v_image = call.floats(v_image_in, "v_image"),
                       v_alphas = call.floats(v_alphas_in, "v_alphas");
  Scene scene = size.scene(records.size(0) / size.images);
  scene.backgrounds = data(backgrounds);
  const bool absolute = options[kAbsolute] != 0;
  const int64_t splats = size.images * scene.gaussians, pixels = size.pixels(), length = sorted.numel();
  const int64_t rows_of_splats = conics.numel() / 3;
  check(records.is_contiguous() && records.numel() == splats * kSplatFloats && splat_starts.numel() == splats + 1 &&
            isect_offsets.numel() == size.images * scene.tiles() && splat_ids.numel() == length &&
            (row_of ? row_of->numel() == splats : rows_of_splats == splats) && alphas.numel() == pixels &&
            last.numel() == pixels && (!v_alphas || v_alphas->numel() == pixels) &&
            (!v_image || v_image->numel() == pixels * scene.image_channels()) &&
            (!scene.expected || (expected && expected->numel() == pixels)) &&
            (!backgrounds || backgrounds->numel() == size.images * scene.channels),
        "rasterize_splats_backward: the sizes of the inputs do not fit together");
  const Allocator memory(records);
  Sizes of_rows = sizes_of(conics);
  of_rows.back() = 2;
  Tensor v_splats = memory.floats({splats, kSplatFloats}), v_means2d = memory.floats(of_rows);
  Tensor v_absolute = memory.floats(absolute ? of_rows : Sizes{0});
  Lists lists = {};
  lists.tile_offsets = int_data(isect_offsets);
  lists.splat_starts = int_data(splat_starts);
  lists.flatten_ids = int_data(splat_ids);
  lists.sorted = int_data(sorted);
  lists.length = length;
  lists.tiles = size.images * scene.tiles();
  const Tensor rows = memory.floats({length, kSplatFloats});
  const PictureGradient from = {data(v_image), data(v_alphas), data(alphas), scene.expected ? data(*expected) : nullptr,
                                int_data(last)};
  instance_gradients(scene, float_data(records), lists, from, absolute, float_data(rows), call.stream);
  const SplatSums out = {data(conics), row_of ? int_data(*row_of) : nullptr, float_data(v_splats), float_data(v_means2d),
                         absolute ? float_data(v_absolute) : nullptr};
  splat_gradients(scene, lists.splat_starts, float_data(rows), out, call.stream);
  call.finish("rasterize_splats_backward");
  return {v_splats, v_means2d, v_absolute};
}

// Return the gradients of the inputs in their order; those not requested by `needs` are empty.
std::vector<Tensor> rasterize_inputs_backward(OptionalTensors given, Tensor radii_in, OptionalTensor row_of_in,
                                              OptionalTensors gradients, std::vector<int64_t> image_dims,
                                              std::vector<int64_t> options, std::vector<double> ranges, std::vector<bool> needs) {
  const CudaCall call(radii_in);
  const Request size(image_dims, options, ranges);
  const SceneInputs inputs(call, size, given);
  const Scene& scene = inputs.scene;
  check(needs.size() == kInputs && gradients.size() == 5, "rasterize_inputs_backward: ", int(kInputs),
        " needs and 5 gradients are expected");
  const Tensor radii = call.ints(radii_in, "radii");
  const OptionalTensor row_of = call.ints(row_of_in, "row_of");
  const int64_t splats = size.images * scene.gaussians;
  check(radii.numel() == 2 * splats && (!row_of || row_of->numel() == splats),
        "rasterize_inputs_backward: radii must be [images, N, 2] and row_of [images, N]");
  OptionalTensor v[5];
  constexpr int kColumns[5] = {kSplatFloats, 2, 1, 3, 1};
  for (int i = 0; i < 5; ++i) {
    v[i] = call.floats(gradients[size_t(i)], "a gradient");
    check(!v[i] || (row_of && i > 0) || v[i]->numel() == splats * kColumns[i],
          "rasterize_inputs_backward: the sizes of the gradients do not fit the inputs");
  }
  const ProjectedGradients from = {
      int_data(radii), row_of ? int_data(*row_of) : nullptr, data(v[0]), data(v[1]), data(v[2]), data(v[3]), data(v[4])};
  const Allocator memory(radii);
  // Outputs of an op must not share memory, so each gradient that is not requested is an empty tensor of its own.
  const auto gradient_of = [&](Input i, bool wanted) {
    return memory.floats(wanted && inputs.tensors[i] ? sizes_of(*inputs.tensors[i]) : Sizes{0});
  };
  std::vector<Tensor> out;
  const bool views = needs[kViewmats] || needs[kCenters];
  for (int i = 0; i < kInputs; ++i) {
    const bool has_none = i == kIntrinsics || i == kBackgrounds;
    out.push_back(gradient_of(Input(i), !has_none && (needs[size_t(i)] || (views && (i == kViewmats || i == kCenters)))));
  }
  if (views)
    check_cuda(cudaMemsetAsync(float_data(out[kViewmats]), 0, size_t(out[kViewmats].numel()) * sizeof(float), call.stream),
               "rasterize_inputs_backward");
  const Tensor sums = memory.floats({views ? size.images * scene.blocks() + 1 : 0, kViewSums});
  const InputGradients to = {float_data(out[kMeans]),  float_data(out[kCovars]),    float_data(out[kQuats]),
                             float_data(out[kScales]), float_data(out[kOpacities]), float_data(out[kColors]),
                             float_data(sums),         float_data(out[kViewmats]),  float_data(out[kCenters])};
  input_gradients(scene, from, to, call.stream);
  call.finish("rasterize_inputs_backward");
  return out;
}

}  // namespace
}  // namespace gsplat::rasterization

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CUDA, m) {
  m.impl("rasterize_splats_backward", GSPLAT_BOX(&gsplat::rasterization::rasterize_splats_backward));
  m.impl("rasterize_inputs_backward", GSPLAT_BOX(&gsplat::rasterization::rasterize_inputs_backward));
}
