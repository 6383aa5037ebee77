"""Geometry of pictures and models: point tracks through video, surface meshes, measurements, and registration to other surfaces."""
