"""Rendering of Gaussians to pictures."""
