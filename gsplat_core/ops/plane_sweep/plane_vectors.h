// Kernels of the plane sweep that are defined in labels_cpu.cpp.
#pragma once

#include "integer_vectors.h"
#include "plane_sweep.h"

namespace GSPLAT_ISA::plane_sweep {

using namespace gsplat::plane_sweep;

int64_t label_scratch(const Volume& in);
int32_t labels(const Volume& in, uint8_t* scratch, const Selected& out);

}  // namespace GSPLAT_ISA::plane_sweep
