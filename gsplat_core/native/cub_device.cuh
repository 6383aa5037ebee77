// CUB radix sort and scan over device memory.
#pragma once

#include "without_iostreams.h"

#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>
