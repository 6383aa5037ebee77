// The kernel functions of the other kernel files of this folder, for the table in records_cpu.cpp.
#pragma once

#include "compositing.h"

namespace GSPLAT_ISA {
void composite_tile(const Compositing& in, int64_t tile, const CompositedPixels& out, float* scratch);
void composite_tile_backward(const Compositing& in, int64_t tile, const CompositingGradients& out, float* scratch);
}  // namespace GSPLAT_ISA
