"""Fused frame path on CUDA: raw Gaussians to a picture, and the backward pass."""
