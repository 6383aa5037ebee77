#include "splat_rays.h"
#include "splat_rays_math.h"
#include "transposed_rows.h"

namespace GSPLAT_ISA::splat_rays {

using gsplat::splat_rays::Gradients;
using gsplat::splat_rays::Inputs;

GSPLAT_INLINE State load_state(const Inputs& in, const View& view, int64_t first, int count) {
  vfloat mean[3], q[4], scale[3];
  load_rows<3>(in.means, first, count, mean);
  load_rows<4>(in.quats, first, count, q);
  load_rows<3>(in.scales, first, count, scale);
  return state_of(view, mean, q, scale);
}

static void forward(const Inputs& in, float* rays, float* normals, int64_t begin, int64_t end) {
  const View view = view_of(in.viewmat, in.K);
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    vfloat ray[10], normal[3];
    rays_of(load_state(in, view, first, count), ray, normal);
    store_rows<10>(rays, first, count, ray);
    store_rows<3>(normals, first, count, normal);
  }
}

static void backward(const Inputs& in, const Gradients& g, int64_t begin, int64_t end) {
  const View view = view_of(in.viewmat, in.K);
  for (int64_t first = begin; first < end; first += kLanes) {
    const int count = int(end - first < kLanes ? end - first : kLanes);
    vfloat v_ray[10], v_normal[3], v_mean[3], v_quat[4], v_scale[3];
    load_rows<10>(g.v_rays, first, count, v_ray);
    load_rows<3>(g.v_normals, first, count, v_normal);
    rays_backward(view, load_state(in, view, first, count), v_ray, v_normal, v_mean, v_quat, v_scale);
    store_rows<3>(g.v_means, first, count, v_mean);
    store_rows<4>(g.v_quats, first, count, v_quat);
    store_rows<3>(g.v_scales, first, count, v_scale);
  }
}

extern const gsplat::splat_rays::Kernels kernels = {forward, backward};

}  // namespace GSPLAT_ISA::splat_rays
