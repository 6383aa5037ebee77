// Parallel loops over torch's CPU threads.
#pragma once

#include <algorithm>

#include "torch_abi.h"

// Call work(row, begin, end) for the items 0 to `items` - 1 of every row, in blocks of `block` items. The blocks, and
// therefore sums over them, do not depend on the number of threads.
template <class Work>
void for_blocks(int64_t rows, int64_t items, int64_t block, const Work& work) {
  const int64_t blocks = (items + block - 1) / block;
  torch::stable::parallel_for(0, rows * blocks, 1, [&](int64_t from, int64_t to) {
    for (int64_t task = from; task < to; ++task) {
      const int64_t begin = task % blocks * block;
      work(task / blocks, begin, std::min(begin + block, items));
    }
  });
}
