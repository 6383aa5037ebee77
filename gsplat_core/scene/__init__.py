"""Scene data shared by all packages of the core: Gaussians, cameras, frames, depth origins. Imports nothing above it."""
