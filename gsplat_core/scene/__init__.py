"""What is rendered and who looks at it: Gaussians, cameras, frames, models."""
