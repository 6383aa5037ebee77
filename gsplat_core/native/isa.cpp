// Detects the processor's vector extensions once, and exports the selected instruction set to Python.
#include "isa.h"

#include <cstdlib>
#include <cstring>

#include "torch_abi.h"

static Isa widest() {
#if defined(GSPLAT_X86)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512cd"))
    return Isa::avx512;
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2")) return Isa::avx2;
#endif
  return Isa::baseline;
}

static Isa chosen() {
  const Isa best = widest();
  const char* wanted = std::getenv("INTRASPLAT_ISA");
  if (wanted == nullptr) return best;
  if (std::strcmp(wanted, "baseline") == 0) return Isa::baseline;
  if (std::strcmp(wanted, "avx2") == 0 && best >= Isa::avx2) return Isa::avx2;
  return best;
}

Isa active_isa() {
  static const Isa isa = chosen();
  return isa;
}

static int64_t active_isa_op() { return int64_t(active_isa()); }

STABLE_TORCH_LIBRARY_IMPL(gsplat_core, CompositeExplicitAutograd, m) { m.impl("active_isa", GSPLAT_BOX(&active_isa_op)); }
