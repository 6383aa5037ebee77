"""The fused frame path: raw Gaussians to a picture, and its gradient back to them, on CUDA."""
