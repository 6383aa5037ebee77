"""Data types that all packages of the core share: Gaussians, cameras, lens distortion, frames, depth origins and range sensors.

This package imports no package that uses it.
"""
