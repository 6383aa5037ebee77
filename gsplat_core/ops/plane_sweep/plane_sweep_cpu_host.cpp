#include "plane_sweep.h"

#include <algorithm>
#include <cmath>
#include <tuple>
#include <vector>

#include "host_call.h"

namespace gsplat::plane_sweep {
namespace {

// Fill the entries of a picture and its mask, to [height + 2, width + 2].
void fill_corners(const uint8_t* picture, const uint8_t* usable, int64_t height, int64_t width, Corners* to) {
  struct Pixel {
    int grey, usable;
  };
  const auto at = [&](int64_t x, int64_t y) -> Pixel {
    if (x < 0 || y < 0 || x >= width || y >= height) return {0, 0};
    return {picture[y * width + x], usable[y * width + x] != 0};
  };
  for (int64_t y = -1; y <= height; ++y) {
    Pixel a = at(-1, y), c = at(-1, y + 1);
    for (int64_t x = -1; x <= width; ++x) {
      const Pixel b = at(x + 1, y), d = at(x + 1, y + 1);
      const int mask = a.usable | b.usable << 1 | c.usable << 2 | d.usable << 3;
      const auto word = [](int value, int position) { return Corners(uint16_t(value)) << (16 * position); };
      *to++ = word(a.grey | mask << kUsableShift, 0) | word(b.grey - a.grey, 1) | word(c.grey - a.grey, 2) |
              word(a.grey - b.grey - c.grey + d.grey, 3);
      a = b, c = d;
    }
  }
}

// Fill Sweep::sums and Sweep::contrast.
void fill_windows(const uint8_t* picture, const uint8_t* usable, int64_t height, int64_t width, int32_t* sums, float* contrast) {
  std::vector<int32_t> columns(static_cast<size_t>(width), 0), squares(static_cast<size_t>(width), 0);
  for (int64_t y = 0; y < height; ++y) {
    std::fill(columns.begin(), columns.end(), 0);
    std::fill(squares.begin(), squares.end(), 0);
    for (int k = -kRadius; k <= kRadius; ++k) {
      const uint8_t* const row = picture + reflected(y + k, height) * width;
      for (int64_t x = 0; x < width; ++x) {
        const int32_t grey = row[x] - kMiddleGrey;
        columns[size_t(x)] += grey, squares[size_t(x)] += grey * grey;
      }
    }
    for (int64_t x = 0; x < width; ++x) {
      int64_t sum = 0, square = 0;
      for (int k = -kRadius; k <= kRadius; ++k) {
        const size_t from = size_t(reflected(x + k, width));
        sum += columns[from], square += squares[from];
      }
      const double variance = double(kWindow * square - sum * sum) + double(kWindow * kWindow * kNoiseGrey * kNoiseGrey);
      sums[y * width + x] = int32_t(sum);
      contrast[y * width + x] = usable[y * width + x] != 0 ? float(1 / std::sqrt(variance)) : 0;
    }
  }
}

// Scale homographies so that their largest coefficient is 1. Coefficients that are not finite map to no pixel.
void fill_homographies(const double* from, int64_t count, float* to) {
  for (int64_t i = 0; i < count; ++i, from += 9, to += 9) {
    double most = 0;
    for (int k = 0; k < 9; ++k) most = std::max(most, std::abs(from[k]));
    for (int k = 0; k < 9; ++k) to[k] = float(from[k] / most);
  }
}

void check_size(int64_t height, int64_t width, int64_t labels) {
  check(height > 0 && width > 0 && height <= kMostSide && width <= kMostSide, "pictures must have 1 to ", kMostSide,
        " pixels on a side, got ", width, " x ", height);
  check(labels > 0 && labels <= kMostLabels, "there must be 1 to ", kMostLabels, " labels, got ", labels);
}

std::tuple<Tensor, Tensor> sweep_planes(Tensor reference_, Tensor usable_, Tensor views_, Tensor views_usable_,
                                        Tensor homographies_) {
  Call call(reference_);
  const Tensor reference = call.take(reference_, ScalarType::Byte, "reference"),
               usable = call.take(usable_, ScalarType::Byte, "usable"), views = call.take(views_, ScalarType::Byte, "views"),
               views_usable = call.take(views_usable_, ScalarType::Byte, "views_usable"),
               homographies = call.take(homographies_, ScalarType::Double, "homographies");
  check(reference.dim() == 2 && usable.dim() == 2 && views.dim() == 3 && views_usable.dim() == 3 && homographies.dim() == 4,
        "reference and usable must be [H, W], views and views_usable [V, H, W], and homographies [D, V, 3, 3]");
  const int64_t height = reference.size(0), width = reference.size(1), count = views.size(0), labels = homographies.size(0);
  const auto is_picture = [&](const Tensor& t, int64_t dim) { return t.size(dim) == height && t.size(dim + 1) == width; };
  check(is_picture(usable, 0) && is_picture(views, 1) && is_picture(views_usable, 1) && views_usable.size(0) == count &&
            homographies.size(1) == count && homographies.size(2) == 3 && homographies.size(3) == 3,
        "pictures and masks must have one size, and views, views_usable and homographies one number of views");
  check_size(height, width, labels);
  check(count > 0 && count <= kMostViews, "there must be 1 to ", kMostViews, " views, got ", count);

  const int64_t pixels = height * width, entries = (height + 2) * (width + 2);
  int32_t* const sums = call.array<int32_t>(pixels);
  float* const contrast = call.array<float>(pixels);
  Corners* const corners = call.array<Corners>(count * entries);
  float* const coefficients = call.array<float>(labels * count * 9);
  fill_windows(reference.const_data_ptr<uint8_t>(), usable.const_data_ptr<uint8_t>(), height, width, sums, contrast);
  for (int64_t view = 0; view < count; ++view)
    fill_corners(views.const_data_ptr<uint8_t>() + view * pixels, views_usable.const_data_ptr<uint8_t>() + view * pixels, height,
                 width, corners + view * entries);
  fill_homographies(homographies.const_data_ptr<double>(), labels * count, coefficients);

  Tensor costs = call.empty({height, width, labels}, ScalarType::Short);
  Tensor votes = call.empty({height, width, labels}, ScalarType::Byte);
  const Volume out = {costs.mutable_data_ptr<int16_t>(), votes.mutable_data_ptr<uint8_t>(), int32_t(height), int32_t(width),
                      int32_t(labels)};
  const Sweep in = {reference.const_data_ptr<uint8_t>(),
                    sums,
                    contrast,
                    corners,
                    coefficients,
                    int32_t(height),
                    int32_t(width),
                    int32_t(count),
                    int32_t(labels)};
  const Kernels& kernel = kernels();
  uint8_t* const scratch = call.array<uint8_t>(kernel.cost_scratch(in));
  for (int64_t first = 0; first < labels; first += kernel.lanes) kernel.costs(in, first, scratch, out);
  return {costs, votes};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> select_planes(Tensor costs_, Tensor votes_) {
  Call call(costs_);
  Tensor costs = call.take(costs_, ScalarType::Short, "costs"), votes = call.take(votes_, ScalarType::Byte, "votes");
  check(costs.dim() == 3 && votes.dim() == 3, "costs and votes must be [H, W, D]");
  const int64_t height = costs.size(0), width = costs.size(1), labels = costs.size(2);
  check(votes.size(0) == height && votes.size(1) == width && votes.size(2) == labels, "costs and votes must have one shape");
  check_size(height, width, labels);
  Tensor label = call.empty({height, width}), unique = call.empty({height, width}), cost = call.empty({height, width});
  Tensor agreeing = call.empty({height, width}, ScalarType::Byte);
  const Volume in = {costs.mutable_data_ptr<int16_t>(), votes.mutable_data_ptr<uint8_t>(), int32_t(height), int32_t(width),
                     int32_t(labels)};
  const int32_t most =
      kernels().labels(in, call.array<uint8_t>(kernels().label_scratch(in)),
                       {mutable_data(label), mutable_data(unique), mutable_data(cost), agreeing.mutable_data_ptr<uint8_t>()});
  check(most <= kDisagrees, "costs must be 0 to ", kDisagrees, ", found ", int32_t(int16_t(most)));
  return {label, unique, cost, agreeing};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("sweep_planes", GSPLAT_BOX(&sweep_planes));
  m.impl("select_planes", GSPLAT_BOX(&select_planes));
}

}  // namespace gsplat::plane_sweep
