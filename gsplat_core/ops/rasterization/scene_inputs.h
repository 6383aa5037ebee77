// Checks the ops' inputs, and fills the kernels' scene description.
#pragma once

#include "call.h"
#include "rasterization.h"

namespace gsplat::rasterization {

constexpr int64_t kMostInts = (int64_t(1) << 31) - 1;
enum DepthMode : int64_t { kNoDepth = 0, kDepthSum = 1, kExpectedDepth = 2 };

// Indices into the tensor lists that the ops receive. `Inputs` and `View` in __init__.py have the same order.
enum Input { kMeans, kCovars, kQuats, kScales, kOpacities, kColors, kViewmats, kIntrinsics, kCenters, kBackgrounds, kInputs };
enum Option {
  kWidth,
  kHeight,
  kCameraModel,
  kDegree,
  kChannels,
  kDepthMode,
  kAntialiased,
  kPacked,
  kAbsolute,
  kCapacity,
  kOptions
};
enum Range { kEps2d, kNearPlane, kFarPlane, kRadiusClip, kRanges };

using OptionalTensors = std::vector<OptionalTensor>;

// Non-tensor arguments of a render call. `image_dims` are the batch dimensions and the number of cameras.
struct Request {
  const Sizes image_dims;
  const std::vector<int64_t> options;
  const std::vector<double> ranges;
  int64_t images = 1, cameras;

  Request(const Sizes& image_dims_, const std::vector<int64_t>& options_, const std::vector<double>& ranges_)
      : image_dims(image_dims_), options(options_), ranges(ranges_), cameras(image_dims_.empty() ? 0 : image_dims_.back()) {
    check(options.size() == kOptions && ranges.size() == kRanges, "rasterize takes ", int(kOptions), " options and ",
          int(kRanges), " ranges, got ", options.size(), " and ", ranges.size());
    constexpr int64_t kMostPixels = int64_t(frame::kMaxTilesAcross) * frame::kTile;
    for (const int64_t size : image_dims) images *= size;
    check(images > 0 && !image_dims.empty(), "rasterize: there must be at least one camera");
    const int64_t width = options[kWidth], height = options[kHeight], channels = options[kChannels];
    check(width > 0 && height > 0 && width <= kMostPixels && height <= kMostPixels, "rasterize: images must have 1 to ",
          kMostPixels, " pixels on a side, got ", width, " x ", height);
    check(images * tile_width() * tile_height() < kMostInts / 32, "rasterize: too many tiles in all images");
    check(options[kCameraModel] >= 0 && options[kCameraModel] <= 2, "rasterize: no camera model ", options[kCameraModel]);
    check(options[kDepthMode] >= kNoDepth && options[kDepthMode] <= kExpectedDepth, "rasterize: no depth mode ",
          options[kDepthMode]);
    check(options[kCapacity] >= 0 && options[kCapacity] < kMostInts, "rasterize: the capacity must be 0 to 2^31 - 2, got ",
          options[kCapacity]);
    check(channels >= 0 && channels <= kMostPlainColors && (channels > 0 || options[kDepthMode] != kNoDepth),
          "rasterize: a picture has 0 to 3 colours, and without any the depth; got ", channels);
  }

  int64_t tile_width() const { return (options[kWidth] + frame::kTile - 1) / frame::kTile; }
  int64_t tile_height() const { return (options[kHeight] + frame::kTile - 1) / frame::kTile; }
  int64_t pixels() const { return images * options[kWidth] * options[kHeight]; }

  // Return the scene's sizes and options; its pointers are not set.
  Scene scene(int64_t gaussians) const {
    check(gaussians * images < kMostInts, "rasterize takes at most 2^31 - 2 Gaussians times cameras, got ", gaussians * images);
    Scene s = {};
    s.gaussians = gaussians;
    s.cameras = int32_t(cameras);
    s.batches = int32_t(images / cameras);
    s.width = int32_t(options[kWidth]);
    s.height = int32_t(options[kHeight]);
    s.tile_width = int32_t(tile_width());
    s.tile_height = int32_t(tile_height());
    s.degree = kPlainColors;
    s.channels = int32_t(options[kChannels]);
    s.depth = options[kDepthMode] != kNoDepth;
    s.expected = options[kDepthMode] == kExpectedDepth;
    s.antialiased = options[kAntialiased] != 0;
    projection::ProjectionInput& in = s.projection;
    in.width = float(s.width);
    in.height = float(s.height);
    in.eps2d = float(ranges[kEps2d]);
    in.near_plane = float(ranges[kNearPlane]);
    in.far_plane = float(ranges[kFarPlane]);
    in.radius_clip = float(ranges[kRadiusClip]);
    in.model = projection::CameraModel(options[kCameraModel]);
    return s;
  }
};

// Gaussians, cameras and backgrounds: the checked tensors, which own the memory that `scene` points to.
struct SceneInputs {
  OptionalTensors tensors;
  Scene scene;

  SceneInputs(const CudaCall& call, const Request& request, const OptionalTensors& given) : tensors(kInputs) {
    constexpr const char* kNames[kInputs] = {"means",  "covars",   "quats", "scales",  "opacities",
                                             "colors", "viewmats", "Ks",    "centers", "backgrounds"};
    check(given.size() == kInputs, "rasterize takes ", int(kInputs), " tensors, got ", given.size());
    for (size_t i = 0; i < kInputs; ++i) tensors[i] = call.floats(given[i], kNames[i]);
    for (const Input i : {kMeans, kOpacities, kViewmats, kIntrinsics})
      check(tensors[i].has_value(), "rasterize needs ", kNames[i]);
    check(tensors[kCovars].has_value() != (tensors[kQuats].has_value() && tensors[kScales].has_value()),
          "rasterize takes covars, or quats and scales");
    scene = request.scene(tensors[kMeans]->dim() >= 2 ? tensors[kMeans]->size(-2) : 0);
    const int64_t images = request.images, rows = images / request.cameras * scene.gaussians;
    const auto fits = [&](Input i, int64_t numbers) {
      check(!tensors[i] || tensors[i]->numel() == numbers, "rasterize: ", kNames[i], " must have ", numbers, " numbers for ",
            scene.gaussians, " Gaussians and ", images, " images, got ", tensors[i] ? tensors[i]->numel() : 0);
    };
    fits(kMeans, 3 * rows), fits(kCovars, 6 * rows), fits(kQuats, 4 * rows), fits(kScales, 3 * rows), fits(kOpacities, rows);
    fits(kViewmats, 16 * images), fits(kIntrinsics, 9 * images), fits(kCenters, 3 * images);
    fits(kBackgrounds, images * scene.channels);
    projection::ProjectionInput& in = scene.projection;
    in.means = data(tensors[kMeans]), in.covars = data(tensors[kCovars]), in.quats = data(tensors[kQuats]);
    in.scales = data(tensors[kScales]), in.opacities = data(tensors[kOpacities]);
    in.viewmat = data(tensors[kViewmats]), in.intrinsics = data(tensors[kIntrinsics]);
    scene.centers = data(tensors[kCenters]);
    scene.backgrounds = data(tensors[kBackgrounds]);
    check(tensors[kColors].has_value() == (scene.channels > 0), "rasterize needs colors, and no more than the picture has");
    if (tensors[kColors]) set_colors(request.options[kDegree], images, rows);
  }

 private:
  void set_colors(int64_t degree, int64_t images, int64_t rows) {
    const Tensor& colors = *tensors[kColors];
    const bool harmonics = degree >= 0;
    const int64_t last = colors.dim() > 0 ? colors.size(-1) : 0, bases = harmonics && colors.dim() > 1 ? colors.size(-2) : 1;
    check(last == scene.channels &&
              (harmonics ? degree <= 4 && last == 3 && bases >= (degree + 1) * (degree + 1) : degree == kPlainColors),
          "rasterize: colors must be [..., N, K, 3] with K >= (degree + 1)^2, or [..., N, channels] without a degree");
    scene.degree = int32_t(degree);
    scene.color_row = int32_t(last * bases);
    scene.colors_per_camera = colors.numel() != rows * scene.color_row;
    check(!scene.colors_per_camera || colors.numel() == images * scene.gaussians * scene.color_row,
          "rasterize: there must be colours for every Gaussian, or for every camera and Gaussian");
    scene.colors = data(colors);
  }
};

}  // namespace gsplat::rasterization
