// Deformation field of truncated bumps in time per Gaussian, with 13 channels each (position 3, rotation 4, log-scale
// 3, colour 3).
#pragma once

#include <cstdint>

#include "cuda_stream.h"
#include "isa.h"
#include "raw_layout.h"

namespace gsplat::basis_field {

constexpr int64_t kBasisChannels = kRawBasisChannels;
constexpr int64_t kBasisPadded =
    kRawColumns;                     // row length of padded deltas and gradients; the field leaves the remaining columns zero
constexpr float kBasisReach = 4.0f;  // in widths; bumps farther away are inactive (BUMP_REACH in Python)
constexpr float kLeastSquaredHeights =
    1e-2f;  // minimum sum of squared heights for a change of the deltas (LEAST_SQUARED_HEIGHTS in Python)

// Order of the learning rates: position, rotation, log-scale, colour, centres, widths.
constexpr int kBasisRates = 6, kBasisCenterRate = 4, kBasisWidthRate = 5;
constexpr int basis_rate_of(int64_t channel) {
  return channel < kRawRotation ? 0 : channel < kRawLogScale ? 1 : channel < kRawColor ? 2 : 3;
}

// CPU view of a field at one time: centres and log-widths [N, B], weights [N, B, 13].
struct BasisBumps {
  const float *centers, *log_widths, *weights;
  int64_t bumps;
  float tau;
  int64_t row;  // columns per row of deltas and gradients: kBasisChannels or kBasisPadded
};

// Parameters that Adam updates in place, their moments of the same shapes, and the number of updates per bump.
struct BasisAdam {
  float *centers, *log_widths, *weights;
  float *m_centers, *m_log_widths, *m_weights, *v_centers, *v_log_widths, *v_weights;
  int32_t* steps;
  int64_t bumps;
  float tau;
  int64_t row;                       // columns per row of the gradient
  float channel_rates[kRawColumns];  // per channel; the last three are unused
  float center_rate, width_rate, beta1, beta2, epsilon;
  // Bias corrections after k updates, k < table_size: 1 / (1 - beta1^k) and 1 / sqrt(1 - beta2^k). Later updates use
  // the last entry.
  const float *inverse_bias1, *inverse_root_bias2;
  int64_t table_size;
};

struct Kernels {
  void (*forward)(const BasisBumps& field, float* deltas, int64_t begin, int64_t end);
  // Writes every element of the three gradients; inactive bumps have zeros.
  void (*backward)(const BasisBumps& field, const float* gradient, float* centers, float* log_widths, float* weights,
                   int64_t begin, int64_t end);
  void (*adam)(const BasisAdam& field, const float* gradient, int64_t begin, int64_t end);
  // Changes the field's `weights` such that its deltas at the time `tau` equal `target` [N, row].
  void (*move_to)(const BasisBumps& field, float* weights, const float* target, int64_t begin, int64_t end);
  // Changes the field's `weights` such that the colour deltas at the time `tau` increase by `change` [N, 3].
  void (*add_colours)(const BasisBumps& field, float* weights, const float* change, int64_t begin, int64_t end);
};

// Arguments of the CUDA kernels: the structs above, with pointers to device memory also for the scalars.
struct DeviceBumps {
  const float *centers, *log_widths, *weights;
  const float* tau;  // [1]
  int64_t count, bumps;
  int32_t row;  // columns per row of deltas and gradients: kBasisChannels or kBasisPadded
};

struct DeviceBasisAdam {
  float *centers, *log_widths, *weights;
  float *m_centers, *m_log_widths, *m_weights, *v_centers, *v_log_widths, *v_weights;
  int32_t* steps;
  const float* tau;    // [1]
  const float* rates;  // [kBasisRates]
  int64_t count, bumps;
  int32_t row;
  float fresh1, fresh2;        // 1 - beta1, 1 - beta2, subtracted in double
  float log_beta1, log_beta2;  // natural logarithms
  float epsilon;
};

void basis_field_on_device(const DeviceBumps& field, float* deltas, cudaStream_t stream);
// Write every element of the three gradients; inactive bumps have zeros.
void basis_field_backward_on_device(const DeviceBumps& field, const float* gradient, float* centers, float* log_widths,
                                    float* weights, cudaStream_t stream);
void basis_field_adam_on_device(const DeviceBasisAdam& field, const float* gradient, cudaStream_t stream);
void basis_field_add_colours_on_device(const DeviceBumps& field, float* weights, const float* change, cudaStream_t stream);
void basis_field_move_to_on_device(const DeviceBumps& field, float* weights, const float* target, cudaStream_t stream);

}  // namespace gsplat::basis_field

GSPLAT_KERNELS(basis_field, Kernels)
