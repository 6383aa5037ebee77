"""This package under gsplat's module names, so that programs written for gsplat run without a change.

`install()` makes `import gsplat` and `from gsplat.strategy import DefaultStrategy` find the functions and classes of
`gsplat_core`. `python -m gsplat_core.as_gsplat SCRIPT ...` does so and runs a program.
"""

from gsplat_core.as_gsplat.finder import install

__all__ = ["install"]
