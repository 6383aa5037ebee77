// What a series of frames keeps of each one's status, in one launch. All pointers are to device memory.
#pragma once

#include "frame_cuda.h"

// One step more, unless the frame's lists were cut; `fits` is then 0 and otherwise 1. Of every word of the status `most` keeps
// the largest, but of the cut the sum.
void count_frame(const int32_t* status, int32_t* most, int64_t* step, float* fits, cudaStream_t stream);
