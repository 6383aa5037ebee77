"""Depth from stereo, parallax, shading or networks, camera poses, and surfaces, meshes and
measurements made from depth.
"""
