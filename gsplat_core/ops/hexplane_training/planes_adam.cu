// Adam over planes and network, or the planes' gradient computed by the same passes.
#include "../frame/frame.h"
#include "cuda_branch.h"
#include "cuda_scratch.h"
#include "plane_update.cuh"

namespace gsplat::hexplane {
namespace {

__device__ AdamScalars scalars_of(const PlanesAdam& options) {
  const double t = double(*options.step), bias1 = 1 - pow(options.beta1, t), bias2 = 1 - pow(options.beta2, t);
  return {{float(double(*options.rate) / bias1), float(1 / sqrt(bias2)), float(1 - options.beta1), float(1 - options.beta2),
           float(options.epsilon), 1},
          options.status != nullptr && options.status[frame::kStatusOverflow] != 0};
}

__global__ void prepare_scalars(PlanesAdam options, AdamScalars* scalars) { *scalars = scalars_of(options); }

__global__ void __launch_bounds__(kThreads) update_network(NetworkParameters parameters, const float* __restrict__ gradient,
                                                           float* first, float* second, PlanesAdam options) {
  __shared__ AdamScalars scalars;
  if (threadIdx.x == 0) scalars = scalars_of(options);
  __syncthreads();
  const int i = int(blockIdx.x) * kThreads + int(threadIdx.x);
  if (scalars.skip || i >= parameters.starts[parameters.count]) return;
  int tensor = 0;
  while (i >= parameters.starts[tensor + 1]) ++tensor;
  const int start = parameters.starts[tensor];
  const PlaneMoments shifted = {parameters.values[tensor] - start, first, second};  // the moments of all tensors are concatenated
  update<1>(
      shifted, i, [&] { return Channels<1>::load(shifted.values + i); }, [&] { return Channels<1>::load(gradient + i); },
      scalars.step);
}

// Update the nodes of a plane, or write their gradients. A thread processes consecutive channels of one node.
template <int kLane, class Sink>
__global__ void __launch_bounds__(kThreads, 5)
    space_nodes(FieldPlanes planes, FieldCells cells, FieldRows rows, PlaneBlocks slots, Sink sink) {
  const int slot = slot_of_block(slots), level = slot / 3, p = slot % 3, channels = planes.channels;
  const int width = planes.sizes[level][u_axis(p)], height = planes.sizes[level][v_axis(p)];
  const int64_t at = (int64_t(int(blockIdx.x) - slots.first_block[slot]) * kThreads + threadIdx.x) * kLane;
  if (at >= int64_t(width) * height * channels) return;
  sink.template take<kLane>(level, p, false, at, [&] {
    const int node = int(at / channels), channel = int(at - int64_t(node) * channels), v = node / width;
    return space_gradient<kLane>(planes, cells, rows, slot, node - v * width, v, channel);
  });
}

template <int kLane, class Sink>
__global__ void __launch_bounds__(kThreads) time_nodes(FieldLines lines, const float* __restrict__ line_gradient,
                                                       const float* time, const int32_t channels, PlaneBlocks slots, Sink sink) {
  const int slot = slot_of_block(slots), level = slot / 3, axis = slot % 3;
  const int64_t row_size = int64_t(lines.widths[level][axis]) * channels;
  const int64_t at = (int64_t(int(blockIdx.x) - slots.first_block[slot]) * kThreads + threadIdx.x) * kLane;
  const int row = int(at / row_size), rows = sink.time_rows(level, axis);
  if (row >= rows) return;
  sink.template take<kLane>(level, axis, true, at, [&] {
    const float share = weight_of(position_on(*time, rows), row);
    if (share == 0.0f) return Channels<kLane>::all(0.0f);
    return Channels<kLane>::all(share) * Channels<kLane>::load(line_gradient + lines.starts[level][axis] + at % row_size);
  });
}

struct UpdateSink {
  PlanesState state;
  const AdamScalars* scalars;

  __device__ int time_rows(int level, int axis) const { return state.time_rows[level][axis]; }
  template <int kLane, class Gradient>
  __device__ void take(int level, int p, bool time, int64_t at, const Gradient& gradient) const {
    if (scalars->skip) return;
    const PlaneMoments& plane = time ? state.time[level][p] : state.space[level][p];
    update<kLane>(plane, at, [&] { return Channels<kLane>::load(plane.values + at); }, gradient, scalars->step);
  }
};

struct StoreSink {
  PlaneGradients gradients;

  __device__ int time_rows(int level, int axis) const { return gradients.time_rows[level][axis]; }
  template <int kLane, class Gradient>
  __device__ void take(int level, int p, bool time, int64_t at, const Gradient& gradient) const {
    gradient().store((time ? gradients.time[level][p] : gradients.space[level][p]) + at);
  }
};

template <int kLane, class Sink>
void visit_nodes(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const FieldRows& rows,
                 const float* line_gradient, const float* time, const int32_t (&time_rows)[kMaxFieldLevels][3], const Sink& sink,
                 bool space, bool times, cudaStream_t stream) {
  PlaneBlocks slots = {}, time_slots = {};
  slots.count = time_slots.count = 3 * planes.levels;
  for (int slot = 0; slot < slots.count; ++slot) {
    const int level = slot / 3, p = slot % 3;
    const FeaturePlane plane = planes.plane(level, p);
    slots.first_block[slot + 1] =
        slots.first_block[slot] + int32_t(blocks_for(int64_t(plane.width) * plane.height * planes.channels, kThreads * kLane));
    time_slots.first_block[slot + 1] =
        time_slots.first_block[slot] +
        int32_t(blocks_for(int64_t(lines.widths[level][p]) * time_rows[level][p] * planes.channels, kThreads * kLane));
  }
  const unsigned space_blocks = unsigned(slots.first_block[slots.count]),
                 time_blocks = unsigned(time_slots.first_block[slots.count]);
  const CudaBranch branch(stream);
  if (space) space_nodes<kLane><<<space_blocks, kThreads, 0, stream>>>(planes, cells, rows, slots, sink);
  if (times)
    time_nodes<kLane><<<time_blocks, kThreads, 0, branch.stream>>>(lines, line_gradient, time, planes.channels, time_slots, sink);
}

// Return bits that are a multiple of 16 if rows and channels are aligned for 16-byte accesses.
uintptr_t alignment(const FieldPlanes& planes, const FieldRows& rows, const float* line_gradient) {
  return uintptr_t(planes.channels) * 4 | uintptr_t(rows.space) | uintptr_t(rows.dense_sums) | uintptr_t(line_gradient);
}

}  // namespace

void planes_adam(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const FieldRows& rows,
                 const float* line_gradient, const float* time, const PlanesState& state, const PlanesAdam& options,
                 CudaScratch& scratch, cudaStream_t stream) {
  UpdateSink sink = {state, scratch.array<AdamScalars>(1)};
  prepare_scalars<<<1, 1, 0, stream>>>(options, const_cast<AdamScalars*>(sink.scalars));
  uintptr_t bits = alignment(planes, rows, line_gradient);
  for (int l = 0; l < planes.levels; ++l)
    for (int p = 0; p < 3; ++p)
      for (const PlaneMoments& plane : {state.space[l][p], state.time[l][p]})
        bits |= uintptr_t(plane.values) | uintptr_t(plane.first) | uintptr_t(plane.second);
  const auto visit = bits % 16 == 0 ? visit_nodes<4, UpdateSink> : visit_nodes<1, UpdateSink>;
  const PlanePenalties& penalties = options.penalties;
  const bool smooth_space = penalties.smoothness != 0.0f,
             smooth_time = penalties.time_smoothness != 0.0f || penalties.sparsity != 0.0f;
  visit(planes, lines, cells, rows, line_gradient, time, state.time_rows, sink, !smooth_space, !smooth_time, stream);
  if (smooth_space)
    smooth_space_planes(bits % 16 == 0, planes, cells, rows, state, penalties.smoothness, sink.scalars, scratch, stream);
  if (smooth_time) smooth_time_planes(planes, lines, line_gradient, time, state, penalties, sink.scalars, stream);
}

void planes_gradient(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const FieldRows& rows,
                     const float* line_gradient, const float* time, const PlaneGradients& gradients, cudaStream_t stream) {
  uintptr_t bits = alignment(planes, rows, line_gradient);
  for (int l = 0; l < planes.levels; ++l)
    for (int p = 0; p < 3; ++p) bits |= uintptr_t(gradients.space[l][p]) | uintptr_t(gradients.time[l][p]);
  const auto visit = bits % 16 == 0 ? visit_nodes<4, StoreSink> : visit_nodes<1, StoreSink>;
  visit(planes, lines, cells, rows, line_gradient, time, gradients.time_rows, StoreSink{gradients}, true, true, stream);
}

void network_adam(const NetworkParameters& parameters, const float* gradient, float* first, float* second,
                  const PlanesAdam& options, cudaStream_t stream) {
  update_network<<<blocks_for(parameters.starts[parameters.count]), kThreads, 0, stream>>>(parameters, gradient, first, second,
                                                                                           options);
}

}  // namespace gsplat::hexplane
