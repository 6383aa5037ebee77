"""Synthetic deforming surgical scene with exact ground truth, rendered by ray casting."""
