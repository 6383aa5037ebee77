// Inverse of a splat's factor, and the gradients of a splat from its sums over the points.
#pragma once

#include "splat_regression.h"

namespace gsplat::splat_regression {

// Invert `matrix` [dims, dims] by Gauss-Jordan elimination with partial pivoting. Returns the absolute determinant; 0 for a
// singular or non-finite matrix.
GSPLAT_HOST_DEVICE double invert(int dims, const float* matrix, double* inverse) {
  double work[kMaxDims * kMaxDims], determinant = 1;
  for (int i = 0; i < dims * dims; ++i) {
    work[i] = double(matrix[i]);
    inverse[i] = i / dims == i % dims ? 1 : 0;
  }
  for (int column = 0; column < dims; ++column) {
    int pivot = column;
    double largest = 0;
    for (int row = column; row < dims; ++row) {
      const double value = work[row * dims + column], size = value < 0 ? -value : value;
      if (size > largest) largest = size, pivot = row;
    }
    if (!(largest > 0 && largest < 1e300)) return 0;
    for (int k = 0; k < dims; ++k) {
      const double a = work[column * dims + k], b = inverse[column * dims + k];
      work[column * dims + k] = work[pivot * dims + k], inverse[column * dims + k] = inverse[pivot * dims + k];
      work[pivot * dims + k] = a, inverse[pivot * dims + k] = b;
    }
    const double diagonal = work[column * dims + column];
    determinant *= largest;
    for (int k = 0; k < dims; ++k) work[column * dims + k] /= diagonal, inverse[column * dims + k] /= diagonal;
    for (int row = 0; row < dims; ++row) {
      if (row == column) continue;
      const double factor = work[row * dims + column];
      for (int k = 0; k < dims; ++k) {
        work[row * dims + k] -= factor * work[column * dims + k];
        inverse[row * dims + k] -= factor * inverse[column * dims + k];
      }
    }
  }
  return determinant > 1e-30 && determinant < 1e30 ? determinant : 0;
}

// Return splat `i` as evaluated: inverse matrix and normalisation. One with a non-finite value or a singular matrix is 0
// everywhere. `log2`: the device's function for doubles.
template <class Log2>
GSPLAT_HOST_DEVICE Splat prepared(const Inputs& in, int64_t i, const Log2& log2) {
  constexpr double kHalfLog2TwoPi = 1.3257480647361595;
  Splat splat = {};
  const int dims = in.dims;
  double inverse[kMaxDims * kMaxDims];
  const double determinant = invert(dims, in.factors + i * dims * dims, inverse);
  splat.log2_norm = -__builtin_huge_valf();
  bool usable = determinant > 0;
  for (int k = 0; k < dims; ++k) {
    splat.centre[k] = in.centres[i * dims + k];
    usable = usable && splat.centre[k] - splat.centre[k] == 0;
  }
  for (int c = 0; c < in.channels; ++c) {
    const float value = in.values[i * in.channels + c];
    usable = usable && value - value == 0;
  }
  if (!usable) {
    for (int k = 0; k < dims; ++k) splat.centre[k] = 0;
    return splat;
  }
  for (int k = 0; k < dims * dims; ++k) splat.whiten[k] = float(inverse[k]);
  splat.log2_norm = float(-log2(determinant) - dims * kHalfLog2TwoPi);
  return splat;
}

// Convert the sums of splat `i` to dL/db = A^-T sum h y and dL/dA = A^-T (sum h y y^T - I sum h).
template <class Sum>
GSPLAT_HOST_DEVICE void gradients_of(const Inputs& in, int64_t i, const Splat& splat, const Sum* moments, const Gradients& out) {
  const int dims = in.dims;
  for (int r = 0; r < dims; ++r) {
    Sum along = 0;
    for (int k = 0; k < dims; ++k) along += Sum(splat.whiten[k * dims + r]) * moments[1 + k];
    out.centres[i * dims + r] = float(along);
    for (int c = 0; c < dims; ++c) {
      Sum entry = 0;
      for (int k = 0; k < dims; ++k) {
        const int low = k < c ? k : c, high = k < c ? c : k;
        const Sum square = moments[1 + dims + low * dims - low * (low - 1) / 2 + high - low];
        entry += Sum(splat.whiten[k * dims + r]) * (square - (k == c ? moments[0] : Sum(0)));
      }
      out.factors[i * dims * dims + r * dims + c] = float(entry);
    }
  }
}

}  // namespace gsplat::splat_regression
