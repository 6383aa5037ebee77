// Include this before headers of others that include <iostream>: it leaves a static initialiser of iostreams in every object, and
// checks.h says why there must be none. What such headers use of <iostream> is declared here; it is discarded as unused.
#pragma once

#include <ostream>

#if defined(__GLIBCXX__) && !defined(_GLIBCXX_IOSTREAM)
#define _GLIBCXX_IOSTREAM 1  // libstdc++'s include guard
namespace std {
extern ostream cerr;
}
#endif
