"""Module `gsplat` of a spawned process, which gives way to that of the import hook."""

from gsplat_core.as_gsplat import take_over

take_over("gsplat")
