"""Placeholder for the module `gsplat` in spawned processes. It installs the import hook, whose module replaces it."""

from gsplat_core.as_gsplat import take_over

take_over("gsplat")
