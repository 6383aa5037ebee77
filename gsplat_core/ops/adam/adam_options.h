// From Adam's options to what its kernels multiply by, in double; apart from adam.h, which kernel files include.
#pragma once

#include <cmath>

#include "adam.h"

inline AdamStep adam_step_of(int64_t step, double learning_rate, double beta1, double beta2, double epsilon, int64_t row_size) {
  return {float(learning_rate / (1 - std::pow(beta1, double(step)))),
          float(1 / std::sqrt(1 - std::pow(beta2, double(step)))),
          float(1 - beta1),
          float(1 - beta2),
          float(epsilon),
          row_size};
}
