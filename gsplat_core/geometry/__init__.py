"""Point tracks, surfaces, meshes, measurements and registration."""
