// Robust reprojection error of a bundle of camera poses and points, and the damped normal equations of its minimum with
// the points eliminated (Triggs et al., "Bundle Adjustment: a Modern Synthesis", 2000, section 6.1), in double precision
// on the calling thread. With the residual r of an observation in pixels, its derivatives J by the camera's twist [2, 6]
// and B by the point [2, 3], and Cauchy's weight w = 1 / (1 + |r / spread|^2), sums over a camera's or a point's
// observations are
//
//   H = sum w J'J   g = sum w J'r   V = sum w B'B   h = sum w B'r   W = w J'B,
//
// and damping d adds d (diag + 1e-9) to H and V. The system of the cameras is S = H - W V^-1 W', right = g - W V^-1 h.
#include <algorithm>
#include <cmath>
#include <limits>
#include <tuple>
#include <vector>

#include "host_call.h"

namespace gsplat::bundle_adjustment {
namespace {

constexpr double kNearest = 1e-3;  // smallest depth in projections, as a share of the median depth
// Levenberg-Marquardt, as in `gsplat_core.poses.bundle`.
constexpr double kDone = 1e-6, kFirstDamping = 1e-4, kLeastDamping = 1e-9, kMostDamping = 1e4, kEasier = 5, kHarder = 8;
constexpr double kOffset = 1e-9;  // added to the diagonals that the damping scales

struct Problem {
  const double* poses;      // [cameras, 4, 4], world to camera
  const double* positions;  // [points, 3]
  const int32_t* camera;    // [observations]
  const int32_t* point;     // [observations]
  const double* rays;       // [observations, 2]
  int64_t cameras, points, observations;
  double focal_px, spread_px, flat_px;
};

// The lower median, as torch.median; 0 without values.
double median(std::vector<double> values) {
  if (values.empty()) return 0;
  const auto middle = values.begin() + int64_t(values.size() - 1) / 2;
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

// Observed points in camera coordinates [observations, 3]. Depths below a share of the median depth are replaced by it.
std::vector<double> in_cameras(const Problem& in) {
  std::vector<double> local(size_t(3 * in.observations)), depths(size_t(in.observations));
  for (int64_t m = 0; m < in.observations; ++m) {
    const double *const pose = in.poses + 16 * int64_t(in.camera[m]), *const p = in.positions + 3 * int64_t(in.point[m]);
    for (int r = 0; r < 3; ++r)
      local[size_t(3 * m + r)] = pose[4 * r] * p[0] + pose[4 * r + 1] * p[1] + pose[4 * r + 2] * p[2] + pose[4 * r + 3];
    depths[size_t(m)] = local[size_t(3 * m + 2)];
  }
  const double nearest = kNearest * std::abs(median(std::move(depths)));
  for (int64_t m = 0; m < in.observations; ++m) {
    double& z = local[size_t(3 * m + 2)];
    z = z < nearest ? nearest : z;  // keeps NaN
  }
  return local;
}

void residual_of(const Problem& in, int64_t m, const double* local, double r[2]) {
  for (int k = 0; k < 2; ++k) r[k] = in.focal_px * (local[k] / local[2] - in.rays[2 * m + k]);
}

double squared(const double r[2], double spread) {
  const double x = r[0] / spread, y = r[1] / spread;
  return x * x + y * y;
}

double median_depth(const Problem& in) {
  std::vector<double> depths(size_t(in.points));
  for (int64_t p = 0; p < in.points; ++p) depths[size_t(p)] = in.positions[3 * p + 2];
  return median(std::move(depths));
}

double cost_of(const Problem& in) {
  const std::vector<double> local = in_cameras(in);
  double cost = 0;
  for (int64_t m = 0; m < in.observations; ++m) {
    double r[2];
    residual_of(in, m, &local[size_t(3 * m)], r);
    cost += std::log1p(squared(r, in.spread_px));
  }
  if (in.flat_px == 0) return cost;
  const double middle = median_depth(in);
  for (int64_t p = 0; p < in.points; ++p) {
    const double off = in.flat_px / in.spread_px * (in.positions[3 * p + 2] / middle - 1);
    cost += off * off;
  }
  return cost;
}

// Weighted derivatives of one observation.
struct Derivatives {
  double r[2], weight, by_pose[2][6], by_point[2][3];
};

Derivatives derivatives_of(const Problem& in, int64_t m, const double* local) {
  Derivatives d;
  residual_of(in, m, local, d.r);
  d.weight = 1 / (1 + squared(d.r, in.spread_px));
  const double x = local[0], y = local[1], z = local[2], inverse = in.focal_px / z;
  const double by_local[2][3] = {{inverse, 0, -x / z * inverse}, {0, inverse, -y / z * inverse}};
  const double by_rotation[3][3] = {{0, z, -y}, {-z, 0, x}, {y, -x, 0}};
  const double* const pose = in.poses + 16 * int64_t(in.camera[m]);
  for (int k = 0; k < 2; ++k)
    for (int c = 0; c < 3; ++c) {
      d.by_pose[k][c] = by_local[k][c];
      d.by_pose[k][3 + c] = d.by_point[k][c] = 0;
      for (int j = 0; j < 3; ++j) {
        d.by_pose[k][3 + c] += by_local[k][j] * by_rotation[j][c];
        d.by_point[k][c] += by_local[k][j] * pose[4 * j + c];
      }
    }
  return d;
}

// Add w J'J to H [6, 6] and w J'r to g [6] of a camera.
void add_camera(const Derivatives& d, double* H, double* g) {
  for (int a = 0; a < 6; ++a) {
    const double first = d.weight * d.by_pose[0][a], second = d.weight * d.by_pose[1][a];
    for (int b = 0; b < 6; ++b) H[6 * a + b] += first * d.by_pose[0][b] + second * d.by_pose[1][b];
    g[a] += first * d.r[0] + second * d.r[1];
  }
}

// Inverse of a symmetric positive definite matrix by Cholesky's factors; NaN if it is not.
void inverse_of(const double V[3][3], double* out) {
  double L[3][3] = {}, inverse[3][3] = {};
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c <= r; ++c) {
      double sum = V[r][c];
      for (int k = 0; k < c; ++k) sum -= L[r][k] * L[c][k];
      L[r][c] = r == c ? (sum > 0 ? std::sqrt(sum) : std::numeric_limits<double>::quiet_NaN()) : sum / L[c][c];
    }
  for (int c = 0; c < 3; ++c)
    for (int r = c; r < 3; ++r) {
      double sum = r == c ? 1 : 0;
      for (int k = c; k < r; ++k) sum -= L[r][k] * inverse[k][c];
      inverse[r][c] = sum / L[r][r];
    }
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) {
      double sum = 0;
      for (int k = std::max(r, c); k < 3; ++k) sum += inverse[k][r] * inverse[k][c];
      out[3 * r + c] = sum;
    }
}

void damp(double* matrix, int size, double damping) {
  for (int k = 0; k < size; ++k) matrix[(size + 1) * k] += damping * (matrix[(size + 1) * k] + kOffset);
}

// Numbers of the observations of each point, ordered by point, and the first one of each point [points + 1].
std::pair<std::vector<int64_t>, std::vector<int64_t>> by_point(const Problem& in) {
  std::vector<int64_t> first(size_t(in.points + 1)), order(size_t(in.observations));
  for (int64_t m = 0; m < in.observations; ++m) ++first[size_t(in.point[m]) + 1];
  for (int64_t p = 0; p < in.points; ++p) first[size_t(p + 1)] += first[size_t(p)];
  std::vector<int64_t> next(first.begin(), first.end() - 1);
  for (int64_t m = 0; m < in.observations; ++m) order[size_t(next[size_t(in.point[m])]++)] = m;
  return {std::move(order), std::move(first)};
}

// S -= E W' for E [6, 3] and the transpose of W [3, 6].
void subtract_product(const double* E, const double* transposed, double* S, int64_t row) {
  for (int r = 0; r < 6; ++r)
    for (int c = 0; c < 6; ++c)
      S[r * row + c] -= E[3 * r] * transposed[c] + E[3 * r + 1] * transposed[6 + c] + E[3 * r + 2] * transposed[12 + c];
}

struct Equations {
  double* S;         // [cameras, 6, cameras, 6]
  double* right;     // [cameras, 6]
  double* inverse;   // [points, 3, 3], V^-1
  double* h;         // [points, 3]
  double* coupling;  // [observations, 6, 3], W
};

void eliminate(const Problem& in, double damping, const Equations& out) {
  const std::vector<double> local = in_cameras(in);
  const auto [order, first] = by_point(in);
  const int64_t row = 6 * in.cameras;
  const auto block = [&](int32_t a, int32_t b) { return out.S + (6 * int64_t(a)) * row + 6 * int64_t(b); };
  const double middle = in.flat_px == 0 ? 1 : median_depth(in);
  std::vector<double> H(size_t(36 * in.cameras)), own(size_t(36 * in.cameras)), rows;
  for (int64_t p = 0; p < in.points; ++p) {
    double V[3][3] = {}, *const h = out.h + 3 * p, *const inverse = out.inverse + 9 * p;
    const int64_t begin = first[size_t(p)], end = first[size_t(p + 1)];
    for (int64_t i = begin; i < end; ++i) {
      const int64_t m = order[size_t(i)];
      const Derivatives d = derivatives_of(in, m, &local[size_t(3 * m)]);
      add_camera(d, &H[size_t(36 * int64_t(in.camera[m]))], out.right + 6 * int64_t(in.camera[m]));
      double* const W = out.coupling + 18 * m;
      for (int c = 0; c < 3; ++c) {
        const double u = d.weight * d.by_point[0][c], v = d.weight * d.by_point[1][c];
        for (int a = 0; a < 6; ++a) W[3 * a + c] = u * d.by_pose[0][a] + v * d.by_pose[1][a];
        for (int a = 0; a < 3; ++a) V[a][c] += u * d.by_point[0][a] + v * d.by_point[1][a];
        h[c] += u * d.r[0] + v * d.r[1];
      }
    }
    if (in.flat_px != 0) {
      const double by_depth = in.flat_px / middle;
      V[2][2] += by_depth * by_depth;
      h[2] += by_depth * in.flat_px * (in.positions[3 * p + 2] / middle - 1);
    }
    damp(&V[0][0], 3, damping);
    inverse_of(V, inverse);
    rows.resize(size_t(36 * (end - begin)));
    for (int64_t i = begin; i < end; ++i) {
      const int64_t m = order[size_t(i)], a = in.camera[m];
      const double* const W = out.coupling + 18 * m;
      double *const E = &rows[size_t(36 * (i - begin))], *const transposed = E + 18;
      for (int r = 0; r < 6; ++r) {
        for (int c = 0; c < 3; ++c) {
          E[3 * r + c] = W[3 * r] * inverse[c] + W[3 * r + 1] * inverse[3 + c] + W[3 * r + 2] * inverse[6 + c];
          transposed[6 * c + r] = W[3 * r + c];
        }
        out.right[6 * a + r] -= E[3 * r] * h[0] + E[3 * r + 1] * h[1] + E[3 * r + 2] * h[2];
      }
      subtract_product(E, transposed, &own[size_t(36 * a)], 6);
    }
    // The blocks of pairs of observations, one of each two that are transposes of each other.
    for (int64_t i = begin; i < end; ++i)
      for (int64_t j = i + 1; j < end; ++j)
        subtract_product(&rows[size_t(36 * (i - begin))], &rows[size_t(36 * (j - begin) + 18)],
                         block(in.camera[order[size_t(i)]], in.camera[order[size_t(j)]]), row);
  }
  for (int64_t r = 0; r < row; ++r) {
    for (int64_t c = 0; c < r; ++c) out.S[r * row + c] = out.S[c * row + r] = out.S[r * row + c] + out.S[c * row + r];
    out.S[r * row + r] *= 2;
  }
  for (int32_t c = 0; c < in.cameras; ++c) {
    damp(&H[size_t(36 * int64_t(c))], 6, damping);
    for (int a = 0; a < 6; ++a)
      for (int b = 0; b < 6; ++b)
        block(c, c)[a * row + b] += H[size_t(36 * int64_t(c) + 6 * a + b)] + own[size_t(36 * int64_t(c) + 6 * a + b)];
  }
}

// Solve A x = b for a symmetric positive definite A [6, 6], which is replaced by its factor. Returns false if A is not.
bool solve(double* A, double* b) {
  for (int r = 0; r < 6; ++r)
    for (int c = 0; c <= r; ++c) {
      double sum = A[6 * r + c];
      for (int k = 0; k < c; ++k) sum -= A[6 * r + k] * A[6 * c + k];
      if (r == c && !(sum > 0)) return false;
      A[6 * r + c] = r == c ? std::sqrt(sum) : sum / A[6 * c + c];
    }
  for (int r = 0; r < 6; ++r) {
    for (int k = 0; k < r; ++k) b[r] -= A[6 * r + k] * b[k];
    b[r] /= A[6 * r + r];
  }
  for (int r = 5; r >= 0; --r) {
    for (int k = r + 1; k < 6; ++k) b[r] -= A[6 * k + r] * b[k];
    b[r] /= A[6 * r + r];
  }
  return true;
}

// out = exp(twist) pose, for a twist of translation and rotation vector in camera coordinates.
void moved(const double* pose, const double* twist, double* out) {
  const double x = twist[3], y = twist[4], z = twist[5], angle = std::sqrt(x * x + y * y + z * z);
  const bool small = angle < 1e-4;
  const double square = angle * angle, a = small ? 1 - square / 6 : std::sin(angle) / angle;
  const double b = small ? 0.5 - square / 24 : (1 - std::cos(angle)) / square;
  const double c = small ? 1.0 / 6 - square / 120 : (angle - std::sin(angle)) / (square * angle);
  const double cross[3][3] = {{0, -z, y}, {z, 0, -x}, {-y, x, 0}};
  double turn[3][3], along[3] = {};
  for (int r = 0; r < 3; ++r)
    for (int q = 0; q < 3; ++q) {
      const double twice = twist[3 + r] * twist[3 + q] - (r == q ? square : 0);  // the square of `cross`
      turn[r][q] = (r == q) + a * cross[r][q] + b * twice;
      along[r] += ((r == q) + b * cross[r][q] + c * twice) * twist[q];
    }
  for (int r = 0; r < 3; ++r)
    for (int q = 0; q < 4; ++q) {
      out[4 * r + q] = q == 3 ? along[r] : 0;
      for (int k = 0; k < 3; ++k) out[4 * r + q] += turn[r][k] * pose[4 * k + q];
    }
  std::copy(pose + 12, pose + 16, out + 12);
}

// Levenberg-Marquardt steps of one camera before fixed points, as `gsplat_core.poses.bundle.descend`. `pose` is in.poses.
void place(const Problem& in, double* pose, int64_t rounds) {
  double damping = kFirstDamping, cost = cost_of(in);
  for (int64_t round = 0; round < rounds; ++round) {
    double H[36] = {}, step[6] = {}, before[16], after[16];
    const std::vector<double> local = in_cameras(in);
    for (int64_t m = 0; m < in.observations; ++m) add_camera(derivatives_of(in, m, &local[size_t(3 * m)]), H, step);
    damp(H, 6, damping);
    bool lower = solve(H, step);
    double new_cost = cost;
    if (lower) {
      for (double& value : step) value = -value;
      moved(pose, step, after);
      std::copy(pose, pose + 16, before);
      std::copy(after, after + 16, pose);
      new_cost = cost_of(in);
      lower = new_cost < cost;
      if (!lower) std::copy(before, before + 16, pose);
    }
    if (!lower) {
      damping *= kHarder;
      if (damping > kMostDamping) return;
      continue;
    }
    const bool done = cost - new_cost < kDone * cost;
    cost = new_cost, damping = std::max(damping / kEasier, kLeastDamping);
    if (done) return;
  }
}

// Checked arguments. The tensors own the memory that `in` points to.
struct Arguments {
  Tensor poses, positions, camera, point, rays;
  Problem in;

  Arguments(const Call& call, const Tensor& poses_, const Tensor& positions_, const Tensor& camera_, const Tensor& point_,
            const Tensor& rays_, double focal_px, double spread_px, double flat_px)
      : poses(call.take(poses_, ScalarType::Double, "poses")),
        positions(call.take(positions_, ScalarType::Double, "points")),
        camera(call.ints(camera_, "camera")),
        point(call.ints(point_, "point")),
        rays(call.take(rays_, ScalarType::Double, "rays")) {
    check(poses.dim() == 3 && poses.size(1) == 4 && poses.size(2) == 4, "bundle adjustment: poses must be [C, 4, 4]");
    check(positions.dim() == 2 && positions.size(1) == 3, "bundle adjustment: points must be [P, 3]");
    const int64_t count = camera.numel();
    check(camera.dim() == 1 && point.dim() == 1 && point.numel() == count && rays.dim() == 2 && rays.size(0) == count &&
              rays.size(1) == 2,
          "bundle adjustment: camera and point must be [M], and rays [M, 2]");
    check(spread_px > 0, "bundle adjustment: spread_px must be positive, got ", spread_px);
    in = {poses.const_data_ptr<double>(),
          positions.const_data_ptr<double>(),
          camera.const_data_ptr<int32_t>(),
          point.const_data_ptr<int32_t>(),
          rays.const_data_ptr<double>(),
          poses.size(0),
          positions.size(0),
          count,
          focal_px,
          spread_px,
          flat_px};
    for (int64_t m = 0; m < count; ++m) {
      check(uint64_t(uint32_t(in.camera[m])) < uint64_t(in.cameras), "camera must be in [0, ", in.cameras, "), found ",
            in.camera[m]);
      check(uint64_t(uint32_t(in.point[m])) < uint64_t(in.points), "point must be in [0, ", in.points, "), found ", in.point[m]);
    }
  }
};

Tensor bundle_cost(Tensor poses, Tensor points, Tensor camera, Tensor point, Tensor rays, double focal_px, double spread_px,
                   double flat_px) {
  const Call call(poses);
  const Arguments arguments(call, poses, points, camera, point, rays, focal_px, spread_px, flat_px);
  Tensor out = call.empty({}, ScalarType::Double);
  *out.mutable_data_ptr<double>() = cost_of(arguments.in);
  return out;
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> bundle_equations(Tensor poses, Tensor points, Tensor camera, Tensor point,
                                                                    Tensor rays, double focal_px, double spread_px,
                                                                    double flat_px, double damping) {
  const Call call(poses);
  const Arguments arguments(call, poses, points, camera, point, rays, focal_px, spread_px, flat_px);
  const Problem& in = arguments.in;
  Tensor S = call.zeros({in.cameras, 6, in.cameras, 6}, ScalarType::Double),
         right = call.zeros({in.cameras, 6}, ScalarType::Double);
  Tensor inverse = call.empty({in.points, 3, 3}, ScalarType::Double), h = call.zeros({in.points, 3}, ScalarType::Double);
  Tensor coupling = call.empty({in.observations, 6, 3}, ScalarType::Double);
  const Equations out = {S.mutable_data_ptr<double>(), right.mutable_data_ptr<double>(), inverse.mutable_data_ptr<double>(),
                         h.mutable_data_ptr<double>(), coupling.mutable_data_ptr<double>()};
  eliminate(in, damping, out);
  return {S, right, inverse, h, coupling};
}

Tensor place_camera(Tensor pose, Tensor points, Tensor rays, double focal_px, double spread_px, int64_t rounds) {
  const Call call(pose);
  const Tensor start = call.take(pose, ScalarType::Double, "pose"), at = call.take(points, ScalarType::Double, "points");
  const Tensor seen = call.take(rays, ScalarType::Double, "rays");
  check(start.numel() == 16 && at.dim() == 2 && at.size(1) == 3 && seen.numel() == 2 * at.size(0),
        "place_camera: pose must be [4, 4], points [N, 3] and rays [N, 2]");
  check(spread_px > 0, "place_camera: spread_px must be positive, got ", spread_px);
  const int64_t count = at.size(0);
  const size_t size = static_cast<size_t>(count);
  std::vector<int32_t> camera(size), point(size);
  for (int64_t m = 0; m < count; ++m) point[size_t(m)] = int32_t(m);
  Tensor out = call.empty({4, 4}, ScalarType::Double);
  double* const result = out.mutable_data_ptr<double>();
  std::copy(start.const_data_ptr<double>(), start.const_data_ptr<double>() + 16, result);
  place({result, at.const_data_ptr<double>(), camera.data(), point.data(), seen.const_data_ptr<double>(), 1, count, count,
         focal_px, spread_px, 0},
        result, rounds);
  return out;
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, GSPLAT_DEVICE, m) {
  m.impl("bundle_cost", GSPLAT_BOX(&bundle_cost));
  m.impl("bundle_equations", GSPLAT_BOX(&bundle_equations));
  m.impl("place_camera", GSPLAT_BOX(&place_camera));
}

}  // namespace gsplat::bundle_adjustment
