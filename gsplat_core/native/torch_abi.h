// torch's stable ABI without its iostreams; include this instead of <torch/csrc/stable/...> (checks.h explains why).
//
// Three parts of torch's headers pull iostreams into the object files: the messages of STD_TORCH_CHECK inside
// TORCH_BOX, the functions behind the two macros that check torch's error codes, and the static initialiser of
// <iostream>. tests/gsplat_core/test_linkage.py fails if a new version of torch adds another one.
#pragma once

#define STRIP_ERROR_MESSAGES 1  // makes STD_TORCH_CHECK throw the text of its condition only

#include <dlfcn.h>

#include "without_iostreams.h"

#if __has_include(<torch/csrc/stable/macros.h>)
#include <torch/csrc/stable/macros.h>
#endif
#include <torch/headeronly/util/shim_utils.h>

#include "checks.h"

namespace gsplat {

// Throw torch's error message for a failed call of its C interface, without the backtrace. torch provides the message
// from 2.13 on.
[[noreturn]] __attribute__((noinline, cold)) inline void torch_call_failed(const char* call) {
  using What = const char* (*)();
  const auto what = reinterpret_cast<What>(dlsym(RTLD_DEFAULT, "torch_exception_get_what_without_backtrace"));
  const char* said = what != nullptr ? what() : nullptr;
  if (said == nullptr) fail("torch refused ", call);
  fail(said, " (torch refused ", call, ")");
}

}  // namespace gsplat

#undef TORCH_ERROR_CODE_CHECK
#define TORCH_ERROR_CODE_CHECK(call)  \
  if ((call) != TORCH_SUCCESS) {      \
    gsplat::torch_call_failed(#call); \
  }
#undef STABLE_TORCH_ERROR_CODE_CHECK
#define STABLE_TORCH_ERROR_CODE_CHECK(call) TORCH_ERROR_CODE_CHECK(call)

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>

#if defined(GSPLAT_CUDA)
#include <torch/csrc/stable/accelerator.h>
#endif

namespace gsplat {

// Boxed function for torch's dispatcher, in place of TORCH_BOX, that lets no C++ exception leave this library. torch's
// copy of the C++ runtime aborts on exceptions thrown by another copy. torch throws instead, from a frame without
// destructors to run.
template <auto function>
struct Boxed {
  static void call(StableIValue* stack, uint64_t arguments, uint64_t results) {
    if (const char* sentence = sentence_of(stack, arguments, results)) aoti_torch_check(false, "gsplat_core", "", 0, sentence);
  }

 private:
  // Run the function; return null, or the error message if it failed.
  __attribute__((noinline)) static const char* sentence_of(StableIValue* stack, uint64_t arguments, uint64_t results) noexcept {
    static thread_local char sentence[2048];
    try {
      torch::stable::detail::boxer<std::remove_pointer_t<decltype(function)>, function>::boxed_fn(stack, arguments, results);
      return nullptr;
    } catch (const std::exception& error) {
      std::snprintf(sentence, sizeof(sentence), "%s", error.what());
      return sentence;
    }
  }
};

}  // namespace gsplat

#define GSPLAT_BOX(function) gsplat::Boxed<function>::call
