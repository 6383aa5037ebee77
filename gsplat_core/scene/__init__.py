"""Scene types shared by training and rendering: Gaussians, cameras, frames, models."""
