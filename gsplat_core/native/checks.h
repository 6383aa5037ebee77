// Argument checks and errors of the core, thrown as std::runtime_error with the expected and the actual value.
//
// torch_abi.h passes the message to torch, and Python raises RuntimeError. Messages are formatted without iostreams: a
// library linked with a static libstdc++ has a second, uninitialised copy of them, and formatting a number with that
// copy crashes the process.
#pragma once

#include <cstdio>
#include <stdexcept>
#include <string>
#include <type_traits>

namespace gsplat {

inline void append(std::string& sentence, const char* part) { sentence += part; }
inline void append(std::string& sentence, const std::string& part) { sentence += part; }

template <class Number, class = std::enable_if_t<std::is_arithmetic_v<Number>>>
void append(std::string& sentence, Number part) {
  if constexpr (std::is_floating_point_v<Number>) {
    char text[32];
    std::snprintf(text, sizeof(text), "%.9g", double(part));
    sentence += text;
  } else {
    sentence += std::to_string(part);
  }
}

template <class... Parts>
[[noreturn]] __attribute__((noinline, cold)) void fail(const Parts&... parts) {
  std::string sentence;
  (append(sentence, parts), ...);
  throw std::runtime_error(sentence);
}

// Throw std::runtime_error with the concatenated `parts` (texts and numbers) unless `holds`.
template <class... Parts>
inline void check(bool holds, const Parts&... parts) {
  if (__builtin_expect(!holds, false)) fail(parts...);
}

}  // namespace gsplat
