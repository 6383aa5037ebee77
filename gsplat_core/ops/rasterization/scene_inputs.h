// The inputs of the op, checked, and what the kernels are told about them.
#pragma once

#include "call.h"
#include "rasterization.h"

namespace gsplat::rasterization {

constexpr int64_t kMostInts = (int64_t(1) << 31) - 1;
enum DepthMode : int64_t { kNoDepth = 0, kDepthSum = 1, kExpectedDepth = 2 };

// The size of the pictures: `image_dims` are the batch dimensions and the number of cameras.
struct PictureSize {
  int64_t images = 1, cameras, width, height;

  PictureSize(const Sizes& image_dims, int64_t width_, int64_t height_)
      : cameras(image_dims.empty() ? 0 : image_dims.back()), width(width_), height(height_) {
    constexpr int64_t kMostPixels = int64_t(kMostTilesAcross) * kFrameTile;
    for (const int64_t size : image_dims) images *= size;
    check(images > 0, "rasterize: there must be at least one camera");
    check(width > 0 && height > 0 && width <= kMostPixels && height <= kMostPixels, "rasterize: images must have 1 to ",
          kMostPixels, " pixels on a side, got ", width, " x ", height);
    check(images * tile_width() * tile_height() < kMostInts / 32, "rasterize: too many tiles in all images");
  }
  int64_t tile_width() const { return (width + kFrameTile - 1) / kFrameTile; }
  int64_t tile_height() const { return (height + kFrameTile - 1) / kFrameTile; }

  // What it says about a scene; all else is left empty.
  Scene scene(int64_t gaussians) const {
    check(gaussians * images <= kMostInts - 1, "rasterize takes at most 2^31 - 2 Gaussians times cameras, got ",
          gaussians * images);
    Scene s = {};
    s.gaussians = gaussians;
    s.cameras = int32_t(cameras);
    s.batches = int32_t(images / cameras);
    s.width = int32_t(width);
    s.height = int32_t(height);
    s.tile_width = int32_t(tile_width());
    s.tile_height = int32_t(tile_height());
    return s;
  }
};

// Gaussians and cameras.
struct SceneInputs {
  Tensor means, opacities, viewmats, intrinsics;
  OptionalTensor covars, quats, scales, colors, centers;
  Scene scene;

  SceneInputs(const CudaCall& call, const PictureSize& size, const Tensor& means_in, const OptionalTensor& covars_in,
              const OptionalTensor& quats_in, const OptionalTensor& scales_in, const Tensor& opacities_in,
              const OptionalTensor& colors_in, const Tensor& viewmats_in, const Tensor& intrinsics_in,
              const OptionalTensor& centers_in, int64_t camera_model, int64_t degree, bool antialiased, double eps2d)
      : means(call.floats(means_in, "means")),
        opacities(call.floats(opacities_in, "opacities")),
        viewmats(call.floats(viewmats_in, "viewmats")),
        intrinsics(call.floats(intrinsics_in, "Ks")),
        covars(call.floats(covars_in, "covars")),
        quats(call.floats(quats_in, "quats")),
        scales(call.floats(scales_in, "scales")),
        colors(call.floats(colors_in, "colors")),
        centers(call.floats(centers_in, "centers")),
        scene(size.scene(means_in.dim() >= 2 ? means_in.size(-2) : 0)) {
    const int64_t images = size.images, rows = images / size.cameras * scene.gaussians;
    const auto fits = [](const OptionalTensor& t, int64_t numbers) { return !t.has_value() || t->numel() == numbers; };
    check(covars.has_value() != (quats.has_value() && scales.has_value()), "rasterize takes covars, or quats and scales");
    check(means.numel() == 3 * rows && opacities.numel() == rows && fits(covars, 6 * rows) && fits(quats, 4 * rows) &&
              fits(scales, 3 * rows) && viewmats.numel() == 16 * images && intrinsics.numel() == 9 * images &&
              fits(centers, 3 * images),
          "rasterize: the sizes of the inputs do not fit together");
    check(camera_model >= 0 && camera_model <= 2, "rasterize: no camera model ", camera_model);
    scene.antialiased = antialiased;
    scene.degree = kPlainColors;
    if (colors) set_colors(degree, images, rows);
    projection::ProjectionInput& in = scene.projection;
    in = {data(means),
          data(covars),
          data(quats),
          data(scales),
          data(opacities),
          data(viewmats),
          data(intrinsics),
          float(size.width),
          float(size.height),
          float(eps2d),
          0,
          0,
          0,
          projection::CameraModel(camera_model)};
    scene.colors = data(colors);
    scene.centers = data(centers);
  }

 private:
  void set_colors(int64_t degree, int64_t images, int64_t rows) {
    const bool harmonics = degree >= 0;
    const int64_t last = colors->dim() > 0 ? colors->size(-1) : 0, bases = harmonics && colors->dim() > 1 ? colors->size(-2) : 1;
    check(harmonics ? degree <= 4 && last == 3 && bases >= (degree + 1) * (degree + 1)
                    : degree == kPlainColors && last >= 1 && last <= kMostPlainColors,
          "rasterize: colors must be [..., N, K, 3] with K >= (degree + 1)^2, or [..., N, 1 to 3] without a degree");
    scene.degree = int32_t(degree);
    scene.color_row = int32_t(last * bases);
    scene.channels = int32_t(last);
    scene.colors_per_camera = colors->numel() != rows * scene.color_row;
    check(!scene.colors_per_camera || colors->numel() == images * scene.gaussians * scene.color_row,
          "rasterize: there must be colours for every Gaussian, or for every camera and Gaussian");
  }
};

}  // namespace gsplat::rasterization
