// Warp-level matrix products of 16 rows by 8 columns, in half precision or in float32 emulated by three tf32 products.
#pragma once

#include <cuda_fp16.h>

#include <cstdint>

// Position of a lane in the operands: rows `group` and `group + 8` of the left operand, and index `quad` of four along
// the summed dimension.
struct WarpPlace {
  int group, quad;
  __device__ WarpPlace() {
    group = int(threadIdx.x) % 32 / 4;
    quad = int(threadIdx.x) % 4;
  }
};

// sums += a b over 16 summed values. The lane's a holds (row, k 0..1), (row + 8, k 0..1), (row, k 2..3), (row + 8, k
// 2..3).
__device__ __forceinline__ void multiply_half(float (&sums)[4], const uint32_t (&a)[4], uint32_t b0, uint32_t b1) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(sums[0]), "+f"(sums[1]), "+f"(sums[2]), "+f"(sums[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}

__device__ __forceinline__ void multiply_tf32(float (&sums)[4], const uint32_t (&a)[4], uint32_t b0, uint32_t b1) {
  asm("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(sums[0]), "+f"(sums[1]), "+f"(sums[2]), "+f"(sums[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}

// A float split into two tf32 numbers of 11 significant bits each; the relative remainder is below 2^-21.
struct Split {
  uint32_t high, low;
  __device__ explicit Split(float x) {
    high = __float_as_uint(x) & 0xffffe000u;
    low = __float_as_uint(x - __uint_as_float(high));
  }
};

struct SplitLeft {
  uint32_t high[4], low[4];
  // Split the lane's elements of a left operand: (row, k 0), (row + 8, k 0), (row, k 1), (row + 8, k 1).
  __device__ SplitLeft(float a0, float a1, float a2, float a3) {
    const Split s0(a0), s1(a1), s2(a2), s3(a3);
    high[0] = s0.high, high[1] = s1.high, high[2] = s2.high, high[3] = s3.high;
    low[0] = s0.low, low[1] = s1.low, low[2] = s2.low, low[3] = s3.low;
  }
};

// sums += a b over 8 summed values at nearly float32 accuracy; the product of the two low parts is omitted.
__device__ __forceinline__ void multiply_split(float (&sums)[4], const SplitLeft& a, float b0, float b1) {
  const Split s0(b0), s1(b1);
  multiply_tf32(sums, a.low, s0.high, s1.high);
  multiply_tf32(sums, a.high, s0.low, s1.low);
  multiply_tf32(sums, a.high, s0.high, s1.high);
}

__device__ __forceinline__ uint32_t pack_halves(float x, float y) {
  const __half2 pair = __floats2half2_rn(x, y);
  return *reinterpret_cast<const uint32_t*>(&pair);
}

// `x < 0` instead of `x > 0`, so that NaN propagates.
__device__ __forceinline__ float rectified(float x) { return x < 0.0f ? 0.0f : x; }

// Start an asynchronous copy of 16 bytes from device to shared memory.
__device__ __forceinline__ void copy_16(void* shared, const void* from) {
  asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(uint32_t(__cvta_generic_to_shared(shared))), "l"(from));
}

// Start an asynchronous copy of 16 bytes to shared memory if `inside`; otherwise write 16 zero bytes. `from` must be
// readable in both cases.
__device__ __forceinline__ void copy_16(void* shared, const void* from, bool inside) {
  asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;" ::"r"(uint32_t(__cvta_generic_to_shared(shared))), "l"(from),
               "r"(inside ? 16 : 0));
}

__device__ __forceinline__ void wait_for_copies() { asm volatile("cp.async.wait_all;" ::: "memory"); }

// Close the current group of asynchronous copies.
__device__ __forceinline__ void commit_copies() { asm volatile("cp.async.commit_group;" ::: "memory"); }

// Wait until all groups of asynchronous copies except the last `kGroups` have completed.
template <int kGroups>
__device__ __forceinline__ void wait_for_copies() {
  asm volatile("cp.async.wait_group %0;" ::"n"(kGroups) : "memory");
}
