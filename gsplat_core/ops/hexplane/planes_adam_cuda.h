// Adam over the HexPlane's planes on CUDA, their gradient summed in the same pass (training_cuda.h). All pointers are to device
// memory.
#pragma once

#include "../adam/adam.h"
#include "training_cuda.h"

using gsplat::adam::AdamStep;

struct PlaneMoments {
  float *values, *first, *second;  // [V, U, C]
};

struct PlanesState {
  PlaneMoments space[kFieldLevels][3], time[kFieldLevels][3];
  int32_t time_rows[kFieldLevels][3];  // V
};

// What the fields' penalties (deformation/regularisers.py) are multiplied by; the mean over planes is taken here.
struct PlanePenalties {
  float smoothness;       // total variation of the space planes
  float time_smoothness;  // second difference in time of the time planes
  float sparsity;         // distance of the time planes from 1
};

// Written by one thread before the pass, so that not every thread raises the decays to the power of the step.
struct AdamScalars {
  AdamStep step;
  bool leave;  // change nothing
};

struct PlanesAdam {
  const float* rate;      // one number
  const int64_t* step;    // counts from 1
  const int32_t* status;  // [4] of a frame, or null: where the third is not 0, nothing is changed
  double beta1, beta2, epsilon;
  PlanePenalties penalties;
};

void planes_adam(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const FieldRows& rows,
                 const float* line_gradient, const float* time, const PlanesState& state, const PlanesAdam& options,
                 CudaScratch& scratch, cudaStream_t stream);

// The pass with penalties (planes_penalties.cu): over the space planes, and over the time planes. `wide`: all rows start at 16
// bytes.
void smooth_space_planes(bool wide, const FieldPlanes& planes, const FieldCells& cells, const FieldRows& rows,
                         const PlanesState& state, float smoothness, const AdamScalars* scalars, CudaScratch& scratch,
                         cudaStream_t stream);
void smooth_time_planes(const FieldPlanes& planes, const FieldLines& lines, const float* line_gradient, const float* time,
                        const PlanesState& state, const PlanePenalties& penalties, const AdamScalars* scalars,
                        cudaStream_t stream);

// The gradients themselves, of the sizes of the planes.
struct PlaneGradients {
  float *space[kFieldLevels][3], *time[kFieldLevels][3];
  int32_t time_rows[kFieldLevels][3];
};

void planes_gradient(const FieldPlanes& planes, const FieldLines& lines, const FieldCells& cells, const FieldRows& rows,
                     const float* line_gradient, const float* time, const PlaneGradients& gradients, cudaStream_t stream);

// The network's weights and biases, whose gradient and moments lie one after the other in their order.
struct NetworkParameters {
  float* values[2 * kFieldLayers];
  int32_t starts[2 * kFieldLayers + 1];
  int32_t count;
};

void network_adam(const NetworkParameters& parameters, const float* gradient, float* first, float* second,
                  const PlanesAdam& options, cudaStream_t stream);
