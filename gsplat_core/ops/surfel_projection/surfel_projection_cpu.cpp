#include "simd.h"
#include "surfel_projection.h"
#include "surfel_projection_math.h"
#include "transposed_rows.h"

namespace GSPLAT_ISA::surfel_projection {

template <int K>
GSPLAT_INLINE void store_valid(float* p, int64_t first, int count, vint valid, const vfloat* v) {
  vfloat shown[K];
  for (int k = 0; k < K; ++k) shown[k] = select(valid, v[k], vfloat{});
  store_rows<K>(p, first, count, shown);
}

static void forward(const Inputs& in, const Outputs& out, int64_t begin, int64_t end) {
  const View view(in);
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    vfloat mean[3], quat[4], scales[3];
    load_rows<3>(in.means, first, count, mean);
    load_rows<4>(in.quats, first, count, quat);
    load_rows<3>(in.scales, first, count, scales);
    const Projected p = project(in, view, mean, quat, scales);
    const vfloat none = vfloat{};
    const vint radii[2] = {to_int(select(p.valid, p.radii[0], none)), to_int(select(p.valid, p.radii[1], none))};
    const vfloat radii_bits[2] = {(vfloat)radii[0], (vfloat)radii[1]};
    store_rows<2>(reinterpret_cast<float*>(out.radii), first, count, radii_bits);
    store_valid<2>(out.means2d, first, count, p.valid, p.mean2d);
    store_valid<1>(out.depths, first, count, p.valid, &p.depth);
    store_valid<9>(out.ray_transforms, first, count, p.valid, p.transform);
    store_valid<3>(out.normals, first, count, p.valid, p.normal);
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

static void backward(const Inputs& in, const OutputGradients& from, const InputGradients& to, int64_t begin, int64_t end) {
  const View view(in);
  vfloat v_view[kMatrixSums] = {};
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    vfloat radii[2];
    load_rows<2>(reinterpret_cast<const float*>(from.radii), first, count, radii);
    const vint valid = ((vint)radii[0] > 0) & (ramp() < float(count));
    BackProjected v = {};
    if (bits(valid) != 0) {
      vfloat mean[3], quat[4], scales[3];
      load_rows<3>(in.means, first, count, mean);
      load_rows<4>(in.quats, first, count, quat);
      load_rows<3>(in.scales, first, count, scales);
      ProjectedGradient gradient = {};
      if (from.means2d != nullptr) load_rows<2>(from.means2d, first, count, gradient.mean2d);
      if (from.depths != nullptr) load_rows<1>(from.depths, first, count, &gradient.depth);
      if (from.ray_transforms != nullptr) load_rows<9>(from.ray_transforms, first, count, gradient.transform);
      if (from.normals != nullptr) load_rows<3>(from.normals, first, count, gradient.normal);
      v = project_backward(view, mean, quat, scales, gradient);
      if (to.viewmat != nullptr)
        for (int i = 0; i < kMatrixSums; ++i) v_view[i] += select(valid, v.viewmat[i], vfloat{});
    }
    write_gradient<3>(to.means, first, count, valid, v.mean, to.accumulate);
    write_gradient<4>(to.quats, first, count, valid, v.quat, to.accumulate);
    write_gradient<3>(to.scales, first, count, valid, v.scales, to.accumulate);
  }
  if (to.viewmat != nullptr)
    for (int i = 0; i < kMatrixSums; ++i) to.viewmat[i] = sum(v_view[i]);
}

extern const gsplat::surfel_projection::Kernels kernels = {forward, backward};

}  // namespace GSPLAT_ISA::surfel_projection
