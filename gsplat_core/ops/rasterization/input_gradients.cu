// One thread per Gaussian: from the gradients of its splats, in camera order, to those of its parameters.
#include "gaussians.cuh"

namespace gsplat::rasterization {
namespace {

constexpr int kWarps = frame::kGaussianThreads / 32;
constexpr int kMoments = 6;

// Gradient of one splat's projected values, from the backward pass of blending.
struct SplatGradient {
  float moments[kMoments], color[3], means2d[2], depth, conic[3], opacity;
};

__device__ inline SplatGradient load_gradient(const Scene& scene, const ProjectedGradients& from, int64_t at) {
  SplatGradient v = {};
  if (from.v_splats != nullptr) {
    const float4* const row = reinterpret_cast<const float4*>(from.v_splats + at * kSplatFloats);
    const float4 a = row[0], b = row[1], c = row[2];
    v.moments[0] = a.x, v.moments[1] = a.y, v.moments[2] = a.z, v.moments[3] = a.w, v.moments[4] = b.x, v.moments[5] = b.y;
    v.color[0] = b.z, v.color[1] = b.w, v.color[2] = c.x;
    if (scene.depth) v.depth = c.y;
  }
  const int64_t row = from.row_of != nullptr ? from.row_of[at] : at;
  if (row < 0) return v;
  if (from.v_means2d != nullptr)
    for (int k = 0; k < 2; ++k) v.means2d[k] = from.v_means2d[2 * row + k];
  if (from.v_depths != nullptr) v.depth += from.v_depths[row];
  if (from.v_conics != nullptr)
    for (int k = 0; k < 3; ++k) v.conic[k] = from.v_conics[3 * row + k];
  if (from.v_opacities != nullptr) v.opacity = from.v_opacities[row];
  return v;
}

template <CameraModel model, bool kViews>
__device__ inline BackProjected project_back(const Scene& scene, const ProjectionInput& in, const float* mean, int64_t n,
                                             const SplatGradient& v, bool conics, float& v_opacity) {
  const View<model> view(in);
  const Geometry geometry = load_geometry(in, n);
  const Point3 p = view.to_camera(mean);
  const ImagePoint image = Projector<model>::forward(view.k, p);
  const Ellipse e = ellipse_of(view, image, geometry.sigma);
  EllipseGradient ellipse = ellipse_gradient(e.a0 + in.eps2d, e.b, e.c0 + in.eps2d, v.moments);
  float (&g)[3] = ellipse.covariance;
  const float opacity = in.opacities[n];
  v_opacity += v.moments[0] / opacity;
  if (scene.antialiased || conics) {
    // The blended opacity is the product of opacity and compensation, and the first moment is the gradient of its
    // logarithm.
    float more[3], v_compensation = 0;
    if (scene.antialiased) {
      const float a = e.a0 + in.eps2d, c = e.c0 + in.eps2d, det = a * c - e.b * e.b;
      const float compensation = compensation_of(e, det, in.compensation_floor);
      v_compensation = fmaf(v.opacity, opacity, v.moments[0] / compensation);
      v_opacity += v.opacity * compensation;
    }
    covariance2d_gradient(e, in, v.conic, scene.antialiased, v_compensation, more);
    for (int k = 0; k < 3; ++k) g[k] += more[k];
  }
  if (!scene.antialiased) v_opacity += v.opacity;
  return project_backward(in, view, mean, geometry, p, image, e, g, v.means2d, v.depth, kViews);
}

template <bool kViews>
__device__ inline BackProjected project_back(const Scene& scene, const ProjectionInput& in, const float* mean, int64_t n,
                                             const SplatGradient& v, bool conics, float& v_opacity) {
  return with_camera_model(in.model, [&](auto model) {
    return project_back<decltype(model)::value, kViews>(scene, in, mean, n, v, conics, v_opacity);
  });
}

// Backpropagate the colour: add the coefficients' gradient to v_c, and set v_mean to the gradient through the view
// direction. The camera centre's gradient is -v_mean. A channel clamped at zero has no gradient.
template <int degree>
__device__ inline void harmonics_back(const float (&center)[3], const float* mean, const float* c, const float* v_color,
                                      float* v_c, float (&v_mean)[3]) {
  constexpr int kBases = kBasesOf<degree>;
  float direction[3], b[kBases], v[3];
  const float inverse = unit_direction(center, mean, direction);
  bases_at<degree>(direction[0], direction[1], direction[2], b);
  for (int j = 0; j < 3; ++j) {
    float color = 0;
#pragma unroll
    for (int k = 0; k < kBases; ++k) color = fmaf(b[k], c[3 * k + j], color);
    v[j] = color + 0.5f >= 0 ? v_color[j] : 0;
  }
#pragma unroll
  for (int k = 0; k < kBases; ++k)
    for (int j = 0; j < 3; ++j) v_c[3 * k + j] = fmaf(b[k], v[j], v_c[3 * k + j]);
  if constexpr (degree > 0)
    direction_gradient<degree>(direction, inverse, c, v, v_mean);  // degree 0 does not depend on the direction
}

template <int degree>
struct ColorSums {
  static constexpr int kFloats = degree == kPlainColors ? kMostPlainColors : 3 * kBasesOf<degree>;
  float v[kFloats] = {};
};

template <int columns>
__device__ inline void store_row(float* to, int64_t row, const float* v) {
  if (to == nullptr) return;
  for (int k = 0; k < columns; ++k) to[columns * row + k] = v[k];
}

// Spherical-harmonics coefficients of a warp's Gaussians, later overwritten by their gradients.
template <int degree>
struct WarpColors {
  StagedHarmonics<degree> coefficients;

  __device__ void load(const Scene& scene, int64_t first, unsigned wanted) {
    const float* const rows = scene.colors + first * scene.color_row;
    coefficients.load(rows, scene.color_row, wanted, reinterpret_cast<uintptr_t>(rows) % 16 == 0);
    coefficients.wait();
  }
  // Store the gradients of `count` Gaussians from `first` on. The whole warp must call it.
  __device__ void store(const Scene& scene, const ColorSums<degree>& sums, float* to, int64_t first, int count, int lane) {
    __syncwarp();
    float* const row = coefficients.row(lane);
#pragma unroll
    for (int k = 0; k < ColorSums<degree>::kFloats; ++k) row[k] = sums.v[k];
    __syncwarp();
    coefficients.store(to + first * scene.color_row, scene.color_row, count);
    __syncwarp();
  }
};
template <>
struct WarpColors<kPlainColors> {
  __device__ void load(const Scene&, int64_t, unsigned) {}
  __device__ void store(const Scene& scene, const ColorSums<kPlainColors>& sums, float* to, int64_t first, int count, int lane) {
    if (lane < count)
      for (int k = 0; k < scene.channels; ++k) to[(first + lane) * scene.color_row + k] = sums.v[k];
  }
};

// All threads of a block process the same batch: each thread has one Gaussian and iterates over the cameras in order.
// With one camera (kOne) the colours' gradient is written before the geometry's is computed, which needs fewer
// registers.
template <int degree, bool kViews, bool kOne>
__global__ void __launch_bounds__(frame::kGaussianThreads, kViews       ? 1
                                                           : degree < 4 ? 4
                                                                        : 2)
    gradients_of_inputs(Scene scene, ProjectedGradients from, InputGradients to) {
  __shared__ float center[3];
  __shared__ WarpColors<degree> warps[kWarps];
  const int64_t blocks = scene.blocks(), batch = blockIdx.x / blocks, block = blockIdx.x % blocks;
  const int64_t n = block * frame::kGaussianThreads + threadIdx.x, N = scene.gaussians;
  const int lane = threadIdx.x % 32;
  const int64_t first = n - lane;
  const int count = int(N - first < 0 ? 0 : N - first < 32 ? N - first : 32);
  WarpColors<degree>& warp = warps[threadIdx.x / 32];
  const bool geometry = to.means != nullptr || to.covars != nullptr || to.quats != nullptr || to.scales != nullptr ||
                        to.opacities != nullptr || kViews;
  const bool colors = scene.colors != nullptr && from.v_splats != nullptr && (to.colors != nullptr || (degree > 0 && geometry));
  BackProjected total = {};
  ColorSums<degree> v_colors;
  float v_opacity = 0, mean[3] = {};
  if (n < N)
    for (int k = 0; k < 3; ++k) mean[k] = scene.projection.means[3 * (batch * N + n) + k];
  const int cameras = kOne ? 1 : scene.cameras;
  for (int camera = 0; camera < cameras; ++camera) {
    const int64_t image = batch * cameras + camera, at = image * N + n;
    const bool seen = n < N && from.radii[2 * at] > 0;
    SplatGradient v = {};
    if (seen) v = load_gradient(scene, from, at);
    const bool has_color = seen && !(v.color[0] == 0 && v.color[1] == 0 && v.color[2] == 0);
    float v_center[3] = {};
    BackProjected g = {};
    if (degree > 0) {
      __syncthreads();  // all threads have read the previous centre
      load_center(scene, image, center);
    }
    if (colors) {
      if constexpr (degree == kPlainColors) {
        if (has_color)
          for (int k = 0; k < kMostPlainColors; ++k) v_colors.v[k] += v.color[k];
      } else {
        const unsigned wanted = __ballot_sync(kWholeWarp, has_color);
        const int64_t set = (scene.colors_per_camera ? image : batch) * N + first;
        if (wanted != 0) warp.load(scene, set, wanted);
        if (has_color) {
          float v_mean[3] = {};
          harmonics_back<degree>(center, mean, warp.coefficients.row(lane), v.color, v_colors.v, v_mean);
          for (int k = 0; k < 3; ++k) total.mean[k] += v_mean[k], v_center[k] = -v_mean[k];
        }
      }
    }
    if (to.colors != nullptr && (kOne || scene.colors_per_camera)) {
      warp.store(scene, v_colors, to.colors, image * N + first, count, lane);
      v_colors = {};
    }
    if (seen && geometry) {
      const bool conics = from.v_conics != nullptr;
      g = project_back<kViews>(scene, seen_by(scene, batch, image), mean, n, v, conics, v_opacity);
      for (int k = 0; k < 3; ++k) total.mean[k] += g.mean[k], total.scales[k] += g.scales[k];
      for (int k = 0; k < 4; ++k) total.quat[k] += g.quat[k];
      for (int k = 0; k < 6; ++k) total.sigma.v[k] += g.sigma.v[k];
    }
    if constexpr (kViews) {
      float sums[kViewSums];
      for (int k = 0; k < 12; ++k) sums[k] = g.viewmat[k];
      for (int k = 0; k < 3; ++k) sums[12 + k] = v_center[k];
      sum_over_block<kViewSums, frame::kGaussianThreads>(sums, to.view_sums + (image * blocks + block) * kViewSums);
    }
  }
  if (to.colors != nullptr && !kOne && !scene.colors_per_camera)
    warp.store(scene, v_colors, to.colors, batch * N + first, count, lane);
  if (n >= N) return;
  const int64_t row = batch * N + n;
  store_row<3>(to.means, row, total.mean);
  store_row<6>(to.covars, row, total.sigma.v);
  store_row<4>(to.quats, row, total.quat);
  store_row<3>(to.scales, row, total.scales);
  store_row<1>(to.opacities, row, &v_opacity);
}

}  // namespace

void input_gradients(const Scene& scene, const ProjectedGradients& from, const InputGradients& to, cudaStream_t stream) {
  const int64_t blocks = scene.batches * scene.blocks();
  const bool views = to.view_sums != nullptr;
  if (blocks > 0)
    with_degree(scene.degree, [&](auto degree) {
      constexpr int kDegree = decltype(degree)::value;
      const auto kernel = views                ? gradients_of_inputs<kDegree, true, false>
                          : scene.cameras == 1 ? gradients_of_inputs<kDegree, false, true>
                                               : gradients_of_inputs<kDegree, false, false>;
      kernel<<<unsigned(blocks), frame::kGaussianThreads, 0, stream>>>(scene, from, to);
    });
  if (views && scene.images() > 0)
    sum_over_blocks<kViewSums>
        <<<unsigned(scene.images()), 32 * kViewSums, 0, stream>>>(to.view_sums, scene.blocks(), to.viewmats, to.centers);
}

}  // namespace gsplat::rasterization
