// Parallel stable counting sort over chunks of items. The result equals a serial stable sort for any number of chunks,
// so it does not depend on the number of threads.
#pragma once

#include <algorithm>
#include <cstdint>
#include <memory>
#include <vector>

#include "torch_abi.h"

// Uninitialised storage for results that are written before they are read; avoids the time to zero it.
template <class T>
std::unique_ptr<T[]> uninitialised(int64_t count) {
  return std::unique_ptr<T[]>(new T[size_t(std::max<int64_t>(count, 1))]);
}

// Sort the outputs of `items` items into buckets and return the number of outputs. count(begin, end, counts) adds to
// counts[b] for every output of items [begin, end) in bucket b. emit(begin, end, cursor) writes each of those outputs
// at cursor[b]++, in the same order. `starts`, if not null, receives the first position of every bucket. `chunk` is the
// minimum number of items per task; smaller tasks cost more to schedule than to run.
template <class Count, class Emit>
int64_t counting_sort(int64_t items, int64_t chunk, int64_t buckets, int32_t* starts, const Count& count, const Emit& emit) {
  // Every chunk also needs a row of counters; limit their total to a few per item.
  const int64_t by_counters = std::max<int64_t>(1, 4 * items / std::max<int64_t>(buckets, 1));
  const int64_t chunks =
      std::max<int64_t>(1, std::min<int64_t>({int64_t(torch::stable::get_num_threads()), items / chunk, by_counters}));
  std::vector<int32_t> counters(size_t(chunks * buckets), 0);
  const auto for_chunks = [&](const auto& work) {
    torch::stable::parallel_for(0, chunks, 1, [&](int64_t first, int64_t last) {
      for (int64_t c = first; c < last; ++c) work(items * c / chunks, items * (c + 1) / chunks, counters.data() + c * buckets);
    });
  };
  for_chunks(count);
  int64_t total = 0;
  for (int64_t b = 0; b < buckets; ++b) {
    if (starts != nullptr) starts[b] = int32_t(total);
    for (int64_t c = 0; c < chunks; ++c) {
      int32_t& counter = counters[size_t(c * buckets + b)];
      const int32_t here = counter;
      counter = int32_t(total);
      total += here;
    }
  }
  for_chunks(emit);
  return total;
}
