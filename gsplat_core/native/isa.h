// Run-time selection of the instruction set. Every kernel file is compiled once per set, in a namespace of that name.
#pragma once

enum class Isa { baseline = 0, avx2 = 1, avx512 = 2 };

// Return the widest supported set, or the one named by INTRASPLAT_ISA (baseline, avx2, avx512) if the processor
// supports it.
Isa active_isa();

// Declares the table of an op's CPU kernels for every instruction set. The op's header uses it once, outside of any namespace:
//
//   namespace gsplat::adam { struct Kernels { int64_t (*step)(...); }; }
//   GSPLAT_KERNELS(adam, Kernels)
//
// The kernel file <op>_cpu.cpp is compiled once per set, with GSPLAT_ISA defined as the set's name. It defines
// `const gsplat::adam::Kernels kernels` in the namespace GSPLAT_ISA::adam. Host files call gsplat::adam::kernels(), which
// returns the table of the active set.
#define GSPLAT_DECLARE_KERNELS_OF(isa, op, Type) \
  namespace isa::op {                            \
  extern const gsplat::op::Type kernels;         \
  }

#if defined(GSPLAT_X86)
#define GSPLAT_KERNELS(op, Type)                      \
  GSPLAT_DECLARE_KERNELS_OF(baseline, op, Type)       \
  GSPLAT_DECLARE_KERNELS_OF(avx2, op, Type)           \
  GSPLAT_DECLARE_KERNELS_OF(avx512, op, Type)         \
  namespace gsplat::op {                              \
  inline const Type& kernels() {                      \
    switch (active_isa()) {                           \
      case Isa::avx512: return ::avx512::op::kernels; \
      case Isa::avx2: return ::avx2::op::kernels;     \
      default: return ::baseline::op::kernels;        \
    }                                                 \
  }                                                   \
  }
#elif defined(GSPLAT_ISA)
#define GSPLAT_KERNELS(op, Type) GSPLAT_DECLARE_KERNELS_OF(GSPLAT_ISA, op, Type)
#else
#define GSPLAT_KERNELS(op, Type)                                   \
  GSPLAT_DECLARE_KERNELS_OF(baseline, op, Type)                    \
  namespace gsplat::op {                                           \
  inline const Type& kernels() { return ::baseline::op::kernels; } \
  }
#endif
