#include "projection.h"
#include "projection_math.h"
#include "simd.h"
#include "transposed_rows.h"

namespace GSPLAT_ISA::projection {

GSPLAT_INLINE Geometry load_geometry(const ProjectionInput& in, int64_t first, int count) {
  if (in.covars != nullptr) {
    Symmetric3 sigma;
    load_rows<6>(in.covars, first, count, sigma.v);
    return geometry_of(sigma);
  }
  vfloat quat[4], scales[3];
  load_rows<4>(in.quats, first, count, quat);
  load_rows<3>(in.scales, first, count, scales);
  return geometry_of(quat, scales);
}

template <CameraModel model>
static void forward_model(const ProjectionInput& in, const ProjectionOutput& out, int64_t begin, int64_t end) {
  const View<model> view(in);
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    vfloat mean[3], opacity;
    load_rows<3>(in.means, first, count, mean);
    if (in.opacities != nullptr) load_rows<1>(in.opacities, first, count, &opacity);
    const Projected p = project(in, view, mean, load_geometry(in, first, count), in.opacities != nullptr ? &opacity : nullptr,
                                out.compensations != nullptr);
    const vfloat none = vfloat{};
    const vint radii[2] = {to_int(select(p.valid, p.radius_x, none)), to_int(select(p.valid, p.radius_y, none))};
    const vfloat radii_bits[2] = {(vfloat)radii[0], (vfloat)radii[1]};
    store_rows<2>(reinterpret_cast<float*>(out.radii), first, count, radii_bits);
    const vfloat means2d[2] = {select(p.valid, p.u, none), select(p.valid, p.v, none)};
    store_rows<2>(out.means2d, first, count, means2d);
    const vfloat depth = select(p.valid, p.depth, none);
    store_rows<1>(out.depths, first, count, &depth);
    const vfloat conics[3] = {select(p.valid, p.conic[0], none), select(p.valid, p.conic[1], none),
                              select(p.valid, p.conic[2], none)};
    store_rows<3>(out.conics, first, count, conics);
    if (out.compensations != nullptr) {
      const vfloat compensation = select(p.valid, p.compensation, none);
      store_rows<1>(out.compensations, first, count, &compensation);
    }
  }
}

template <int K>
GSPLAT_INLINE void write_gradient(float* p, int64_t first, int count, vint valid, vfloat* v, bool accumulate) {
  for (int k = 0; k < K; ++k) v[k] = select(valid, v[k], vfloat{});
  if (accumulate)
    add_rows<K>(p, first, count, v);
  else
    store_rows<K>(p, first, count, v);
}

template <CameraModel model>
static void backward_model(const ProjectionInput& in, const ProjectionOutputGradient& from, const ProjectionInputGradient& to,
                           int64_t begin, int64_t end) {
  const View<model> view(in);
  vfloat v_view[12] = {};
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    vfloat radii[2];
    load_rows<2>(reinterpret_cast<const float*>(from.radii), first, count, radii);
    const vint valid = ((vint)radii[0] > 0) & (ramp() < float(count));
    BackProjected v = {};
    if (bits(valid) != 0) {
      vfloat mean[3];
      load_rows<3>(in.means, first, count, mean);
      ProjectedGradient gradient = {};
      if (from.means2d != nullptr) load_rows<2>(from.means2d, first, count, gradient.means2d);
      if (from.depths != nullptr) load_rows<1>(from.depths, first, count, &gradient.depth);
      if (from.conics != nullptr) load_rows<3>(from.conics, first, count, gradient.conic);
      if (from.compensations != nullptr) load_rows<1>(from.compensations, first, count, &gradient.compensation);
      v = project_backward(in, view, mean, load_geometry(in, first, count), gradient, from.compensations != nullptr,
                           to.viewmat != nullptr);
      if (to.viewmat != nullptr)
        for (int i = 0; i < 12; ++i) v_view[i] += select(valid, v.viewmat[i], vfloat{});
    }
    write_gradient<3>(to.means, first, count, valid, v.mean, to.accumulate);
    if (in.covars != nullptr) {
      write_gradient<6>(to.covars, first, count, valid, v.sigma.v, to.accumulate);
    } else {
      write_gradient<4>(to.quats, first, count, valid, v.quat, to.accumulate);
      write_gradient<3>(to.scales, first, count, valid, v.scales, to.accumulate);
    }
  }
  if (to.viewmat != nullptr)
    for (int i = 0; i < 12; ++i) to.viewmat[i] = sum(v_view[i]);
}

static void forward(const ProjectionInput& in, const ProjectionOutput& out, int64_t begin, int64_t end) {
  switch (in.model) {
    case kOrtho: return forward_model<kOrtho>(in, out, begin, end);
    case kFisheye: return forward_model<kFisheye>(in, out, begin, end);
    default: return forward_model<kPinhole>(in, out, begin, end);
  }
}

static void backward(const ProjectionInput& in, const ProjectionOutputGradient& from, const ProjectionInputGradient& to,
                     int64_t begin, int64_t end) {
  switch (in.model) {
    case kOrtho: return backward_model<kOrtho>(in, from, to, begin, end);
    case kFisheye: return backward_model<kFisheye>(in, from, to, begin, end);
    default: return backward_model<kPinhole>(in, from, to, begin, end);
  }
}

extern const Kernels kernels = {forward, backward};

}  // namespace GSPLAT_ISA::projection
