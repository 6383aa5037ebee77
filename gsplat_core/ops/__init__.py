"""Compiled operations of the core, one folder each: Python wrapper, C++ and CUDA kernels, registration.

Beside them are the loader of the compiled library, shared argument checks, and plain-torch versions of some operations.
"""
