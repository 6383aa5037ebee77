"""Published models and snapshots: Gaussians with their deformation field, as renderers, exports and files read them."""
