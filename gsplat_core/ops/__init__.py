"""The operations of the core, one folder each: Python wrapper, C++ kernels, registration."""
