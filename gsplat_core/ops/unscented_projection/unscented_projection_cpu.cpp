#include "transposed_rows.h"
#include "unscented_projection.h"
#include "unscented_projection_math.h"

namespace GSPLAT_ISA::unscented_projection {

GSPLAT_INLINE Gaussian load_gaussian(const Inputs& in, int64_t first, int count) {
  vfloat mean[3], quat[4], scale[3];
  load_rows<3>(in.means, first, count, mean);
  load_rows<4>(in.quats, first, count, quat);
  load_rows<3>(in.scales, first, count, scale);
  return gaussian_of(mean, quat, scale, in.spread);
}

static void forward(const Inputs& in, const Outputs& out, int64_t image, int64_t begin, int64_t end) {
  const Lens lens(in, image);
  const int64_t source = image / in.size.cameras * in.size.gaussians, row = image * in.size.gaussians;
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    vfloat opacity;
    if (in.opacities != nullptr) load_rows<1>(in.opacities, source + first, count, &opacity);
    const auto p = project(in, lens, load_gaussian(in, source + first, count), in.opacities != nullptr ? &opacity : nullptr,
                           out.compensations != nullptr);
    const vfloat none = vfloat{};
    const vint radii[2] = {to_int(select(p.valid, p.radius_x, none)), to_int(select(p.valid, p.radius_y, none))};
    const vfloat radii_bits[2] = {(vfloat)radii[0], (vfloat)radii[1]};
    store_rows<2>(reinterpret_cast<float*>(out.radii), row + first, count, radii_bits);
    const vfloat means2d[2] = {select(p.valid, p.u, none), select(p.valid, p.v, none)};
    store_rows<2>(out.means2d, row + first, count, means2d);
    const vfloat depth = select(p.valid, p.depth, none);
    store_rows<1>(out.depths, row + first, count, &depth);
    const vfloat conics[3] = {select(p.valid, p.conic[0], none), select(p.valid, p.conic[1], none),
                              select(p.valid, p.conic[2], none)};
    store_rows<3>(out.conics, row + first, count, conics);
    if (out.compensations != nullptr) {
      const vfloat compensation = select(p.valid, p.compensation, none);
      store_rows<1>(out.compensations, row + first, count, &compensation);
    }
  }
}

static void backward(const Inputs& in, const Gradients& from, int64_t batch, int64_t begin, int64_t end) {
  const int64_t source = batch * in.size.gaussians;
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    const Gaussian gaussian = load_gaussian(in, source + first, count);
    GaussianGradient total = {};
    for (int64_t camera = 0; camera < in.size.cameras; ++camera) {
      const int64_t image = batch * in.size.cameras + camera, row = image * in.size.gaussians + first;
      vfloat radii[2];
      load_rows<2>(reinterpret_cast<const float*>(from.radii), row, count, radii);
      const vint valid = ((vint)radii[0] > 0) & (ramp() < float(count));
      if (bits(valid) == 0) continue;
      projection::ProjectedGradient v = {};
      if (from.means2d != nullptr) load_rows<2>(from.means2d, row, count, v.means2d);
      if (from.depths != nullptr) load_rows<1>(from.depths, row, count, &v.depth);
      if (from.conics != nullptr) load_rows<3>(from.conics, row, count, v.conic);
      if (from.compensations != nullptr) load_rows<1>(from.compensations, row, count, &v.compensation);
      const GaussianGradient g = project_backward(in, Lens(in, image), gaussian, v, from.compensations != nullptr);
      for (int k = 0; k < 3; ++k) total.mean[k] += select(valid, g.mean[k], vfloat{});
      for (int k = 0; k < 4; ++k) total.quat[k] += select(valid, g.quat[k], vfloat{});
      for (int k = 0; k < 3; ++k) total.scale[k] += select(valid, g.scale[k], vfloat{});
    }
    store_rows<3>(from.v_means, source + first, count, total.mean);
    store_rows<4>(from.v_quats, source + first, count, total.quat);
    store_rows<3>(from.v_scales, source + first, count, total.scale);
  }
}

extern const Kernels kernels = {forward, backward};

}  // namespace GSPLAT_ISA::unscented_projection
