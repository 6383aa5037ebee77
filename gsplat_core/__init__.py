"""The splatting core: Gaussians, cameras, rasterization, deformation, losses, training and file formats."""
