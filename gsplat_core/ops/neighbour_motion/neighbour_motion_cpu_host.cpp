// Affine motion around points from the motion of their neighbours, forward and backward, for the CPU. With d1 and d2 the
// offsets of the K neighbours at both times, s the mean of |d1|^2 and R the point's own rotation,
//
//   F = (sum d2 d1' / (K s) + stiffness R) W,  W = (sum d1 d1' / (K s) + stiffness I)^-1.
//
// Points without neighbours, or with all of them at one place, have F = R.
#include <tuple>

#include "counting_sort.h"
#include "host_call.h"

namespace gsplat::neighbour_motion {
namespace {

constexpr int64_t kGrain = 1024;  // minimum points per task

struct Inputs {
  const float* before;        // [count, 3]
  const int32_t* neighbours;  // [count, each]
  int64_t count, each;
  float stiffness;
};

// Inverse W of a point's moments, and 1 / (K s); scale is 0 where F = R.
struct Moments {
  float inverse[3][3];
  float scale;
};

Moments moments_of(const Inputs& in, int64_t i) {
  const float* const own = in.before + 3 * i;
  float sums[6] = {};  // xx, xy, xz, yy, yz, zz
  for (int64_t k = 0; k < in.each; ++k) {
    const float* const other = in.before + 3 * int64_t(in.neighbours[i * in.each + k]);
    const float x = other[0] - own[0], y = other[1] - own[1], z = other[2] - own[2];
    sums[0] += x * x, sums[1] += x * y, sums[2] += x * z, sums[3] += y * y, sums[4] += y * z, sums[5] += z * z;
  }
  Moments m = {};
  const float trace = sums[0] + sums[3] + sums[5];  // K s
  if (!(trace > 0)) return m;
  m.scale = 1 / trace;
  for (float& sum : sums) sum *= m.scale;
  // In double precision, because neighbours on a line or plane leave small determinants.
  const double a = double(sums[0]) + in.stiffness, b = sums[1], c = sums[2], d = double(sums[3]) + in.stiffness, e = sums[4];
  const double f = double(sums[5]) + in.stiffness, aa = d * f - e * e, ab = c * e - b * f, ac = b * e - c * d;
  const double bb = a * f - c * c, bc = b * c - a * e, cc = a * d - b * b, determinant = a * aa + b * ab + c * ac;
  const double w[3][3] = {{aa, ab, ac}, {ab, bb, bc}, {ac, bc, cc}};
  for (int r = 0; r < 3; ++r)
    for (int q = 0; q < 3; ++q) m.inverse[r][q] = float(w[r][q] / determinant);
  return m;
}

// out = a W
void times(const float* a, const float w[3][3], float* out) {
  for (int r = 0; r < 3; ++r)
    for (int q = 0; q < 3; ++q) out[3 * r + q] = a[3 * r] * w[0][q] + a[3 * r + 1] * w[1][q] + a[3 * r + 2] * w[2][q];
}

void forward(const Inputs& in, const float* after, const float* turned, float* out) {
  torch::stable::parallel_for(0, in.count, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const Moments m = moments_of(in, i);
      const float* const turn = turned + 9 * i;
      if (m.scale == 0) {
        std::copy(turn, turn + 9, out + 9 * i);
        continue;
      }
      const float *const own = in.before + 3 * i, *const moved = after + 3 * i;
      float both[9] = {};
      for (int64_t k = 0; k < in.each; ++k) {
        const int64_t j = in.neighbours[i * in.each + k];
        for (int r = 0; r < 3; ++r)
          for (int q = 0; q < 3; ++q) both[3 * r + q] += (after[3 * j + r] - moved[r]) * (in.before[3 * j + q] - own[q]);
      }
      for (int r = 0; r < 9; ++r) both[r] = both[r] * m.scale + in.stiffness * turn[r];
      times(both, m.inverse, out + 9 * i);
    }
  });
}

void backward(const Inputs& in, const float* v_out, float* v_after, float* v_turned) {
  // Gradients of the sums of d2 d1', scaled; a neighbour's gradient is this matrix times its offset d1.
  const auto scaled = uninitialised<float>(9 * in.count);
  torch::stable::parallel_for(0, in.count, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const Moments m = moments_of(in, i);
      if (m.scale == 0) {
        std::fill(&scaled[size_t(9 * i)], &scaled[size_t(9 * i)] + 9, 0.0f);
        std::copy(v_out + 9 * i, v_out + 9 * i + 9, v_turned + 9 * i);
        continue;
      }
      float v_both[9];
      times(v_out + 9 * i, m.inverse, v_both);
      for (int r = 0; r < 9; ++r) scaled[size_t(9 * i + r)] = m.scale * v_both[r], v_turned[9 * i + r] = in.stiffness * v_both[r];
    }
  });
  // Invert the neighbour lists: find the points of which each point is a neighbour, in a fixed order.
  const int64_t pairs = in.count * in.each;
  auto first = uninitialised<int32_t>(in.count + 1), owners = uninitialised<int32_t>(pairs);
  const auto add = [&](int64_t begin, int64_t end, int32_t* counters) {
    for (int64_t p = begin; p < end; ++p) ++counters[in.neighbours[p]];
  };
  counting_sort(pairs, 1 << 15, in.count, first.get(), add, [&](int64_t begin, int64_t end, int32_t* cursors) {
    for (int64_t p = begin; p < end; ++p) owners[size_t(cursors[in.neighbours[p]]++)] = int32_t(p / in.each);
  });
  first[size_t(in.count)] = int32_t(pairs);
  torch::stable::parallel_for(0, in.count, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t j = begin; j < end; ++j) {
      float sum[3] = {};
      const auto add_product = [&](const float* matrix, const float* to, const float* from, float sign) {
        const float x = sign * (to[0] - from[0]), y = sign * (to[1] - from[1]), z = sign * (to[2] - from[2]);
        for (int r = 0; r < 3; ++r) sum[r] += matrix[3 * r] * x + matrix[3 * r + 1] * y + matrix[3 * r + 2] * z;
      };
      const float* const own = in.before + 3 * j;
      for (int32_t at = first[size_t(j)]; at < first[size_t(j) + 1]; ++at) {
        const int64_t i = owners[size_t(at)];
        add_product(&scaled[size_t(9 * i)], own, in.before + 3 * i, 1);
      }
      for (int64_t k = 0; k < in.each; ++k)
        add_product(&scaled[size_t(9 * j)], in.before + 3 * int64_t(in.neighbours[j * in.each + k]), own, -1);
      std::copy(sum, sum + 3, v_after + 3 * j);
    }
  });
}

// Checked inputs of either pass. The tensors own the memory that `in` points to.
struct Arguments {
  Tensor before, neighbours;
  Inputs in;

  Arguments(const Call& call, const Tensor& before_, const Tensor& neighbours_, double stiffness)
      : before(call.floats(before_, "before")), neighbours(call.ints(neighbours_, "neighbours")) {
    check(before.dim() == 2 && before.size(1) == 3, "neighbour_motion: before must be [N, 3]");
    check(neighbours.dim() == 2 && neighbours.size(0) == before.size(0), "neighbour_motion: neighbours must be [N, K]");
    in = {data(before), neighbours.const_data_ptr<int32_t>(), before.size(0), neighbours.size(1), float(stiffness)};
    check(in.count * std::max<int64_t>(in.each, 9) < (int64_t(1) << 31) - 1, "neighbour_motion: too many neighbours");
    for (int64_t i = 0; i < in.count * in.each; ++i)
      check(uint64_t(uint32_t(in.neighbours[i])) < uint64_t(in.count), "neighbours must be in [0, ", in.count, "), found ",
            in.neighbours[i]);
  }
};

Tensor neighbour_motion(Tensor before, Tensor after, Tensor turned, Tensor neighbours, double stiffness) {
  const Call call(before);
  const Arguments arguments(call, before, neighbours, stiffness);
  const Tensor after_ = call.floats(after, "after"), turned_ = call.floats(turned, "turned");
  check(after_.numel() == 3 * arguments.in.count && turned_.numel() == 9 * arguments.in.count,
        "neighbour_motion: after must be [N, 3] and turned [N, 3, 3]");
  Tensor out = call.empty({arguments.in.count, 3, 3});
  forward(arguments.in, data(after_), data(turned_), mutable_data(out));
  return out;
}

std::tuple<Tensor, Tensor> neighbour_motion_backward(Tensor before, Tensor neighbours, double stiffness, Tensor v_out) {
  const Call call(before);
  const Arguments arguments(call, before, neighbours, stiffness);
  const Tensor v = call.floats(v_out, "v_out");
  check(v.numel() == 9 * arguments.in.count, "neighbour_motion_backward: v_out must be [N, 3, 3]");
  Tensor v_after = call.empty({arguments.in.count, 3}), v_turned = call.empty({arguments.in.count, 3, 3});
  backward(arguments.in, data(v), mutable_data(v_after), mutable_data(v_turned));
  return {v_after, v_turned};
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("neighbour_motion", GSPLAT_BOX(&neighbour_motion));
  m.impl("neighbour_motion_backward", GSPLAT_BOX(&neighbour_motion_backward));
}

}  // namespace gsplat::neighbour_motion
