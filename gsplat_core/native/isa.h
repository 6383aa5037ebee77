// Run-time choice of the instruction set: every kernel file is compiled once per set, in a namespace of that name.
#pragma once

enum class Isa { baseline = 0, avx2 = 1, avx512 = 2 };

// The widest set that this processor has, or the one that INTRASPLAT_ISA names (baseline, avx2, avx512) when it has it.
Isa active_isa();

// A kernel header declares its functions once with this macro, and `pick` returns the table of the active set:
//
//   struct AdamKernels { void (*step)(...); };
//   GSPLAT_DECLARE_KERNELS(AdamKernels, adam_kernels)
//
// The kernel file defines `const AdamKernels GSPLAT_ISA::adam_kernels`.
#define GSPLAT_DECLARE_TABLE(isa, Type, name) \
  namespace isa {                             \
  extern const Type name;                     \
  }

#if defined(GSPLAT_X86)
#define GSPLAT_DECLARE_KERNELS(Type, name)   \
  GSPLAT_DECLARE_TABLE(baseline, Type, name) \
  GSPLAT_DECLARE_TABLE(avx2, Type, name)     \
  GSPLAT_DECLARE_TABLE(avx512, Type, name)   \
  inline const Type& name() {                \
    switch (active_isa()) {                  \
      case Isa::avx512: return avx512::name; \
      case Isa::avx2: return avx2::name;     \
      default: return baseline::name;        \
    }                                        \
  }
#elif defined(GSPLAT_ISA)
#define GSPLAT_DECLARE_KERNELS(Type, name) GSPLAT_DECLARE_TABLE(GSPLAT_ISA, Type, name)
#else
#define GSPLAT_DECLARE_KERNELS(Type, name)   \
  GSPLAT_DECLARE_TABLE(baseline, Type, name) \
  inline const Type& name() { return baseline::name; }
#endif
