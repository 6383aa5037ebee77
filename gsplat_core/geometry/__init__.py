"""Depth of a frame from its two eyes, from a moving scope or from its light, and what is made of depth: surfaces, meshes, measurement."""
