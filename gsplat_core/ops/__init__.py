"""Operations of the core, one folder each: Python wrapper, C++ and CUDA kernels, registration."""
