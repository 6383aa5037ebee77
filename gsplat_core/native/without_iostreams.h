// Include this before third-party headers that include <iostream>. That header adds a static initialiser of iostreams
// to every object file (checks.h explains the problem). The names that those headers use from <iostream> are declared
// here; the linker discards them as unused.
#pragma once

#include <ostream>

#if defined(__GLIBCXX__) && !defined(_GLIBCXX_IOSTREAM)
#define _GLIBCXX_IOSTREAM 1  // libstdc++'s include guard
namespace std {
extern ostream cerr;
}
#endif
