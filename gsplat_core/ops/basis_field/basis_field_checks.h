// The checks of the basis field's op files, whatever the device.
#pragma once

#include "basis_field.h"
#include "tensor_checks.h"

inline void check_shapes(const Tensor& centers, const Tensor& log_widths, const Tensor& weights) {
  check(centers.dim() == 2 && log_widths.dim() == 2 && weights.dim() == 3 && weights.size(2) == kBasisChannels &&
            centers.size(0) == weights.size(0) && centers.size(1) == weights.size(1) && log_widths.size(0) == centers.size(0) &&
            log_widths.size(1) == centers.size(1),
        "basis_field takes centers [N, B], log_widths [N, B] and weights [N, B, 13]");
}

inline void check_gradient(const Tensor& gradient, const Tensor& centers) {
  check(gradient.dim() == 2 && gradient.size(0) == centers.size(0) &&
            (gradient.size(1) == kBasisChannels || gradient.size(1) == kBasisPadded),
        "the gradient must be [N, 13] or [N, 16] with N = ", centers.size(0));
}

// What Adam updates in place: the field's three tensors, then both moments of each.
inline void check_state(std::initializer_list<const Tensor*> updated, const Tensor& steps) {
  for (const Tensor* t : updated)
    check(t->is_contiguous() && t->scalar_type() == ScalarType::Float,
          "basis_field_backward_adam_ updates contiguous float32 tensors in place");
  const Tensor& centers = **updated.begin();
  for (const Tensor* t : updated)
    check(t->size(0) == centers.size(0) && t->size(1) == centers.size(1) && t->is_cpu() == centers.is_cpu(),
          "moments must have the field's number of Gaussians and bumps, and its device");
  check(steps.is_contiguous() && steps.scalar_type() == ScalarType::Int && steps.numel() == centers.numel(),
        "steps must be contiguous int32 [N, B]");
}
