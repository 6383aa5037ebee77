// How host code of the CPU spreads work over torch's threads.
#pragma once

#include <algorithm>

#include "torch_abi.h"

// Calls work(row, begin, end) for the items 0 to `items` - 1 of every row, in blocks of `block` items. The blocks are the same
// for any number of threads, and so are sums over them.
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
