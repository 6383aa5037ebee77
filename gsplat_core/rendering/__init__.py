"""Renderers of Gaussians, by alpha blending and by other methods: pictures, depth, normals and optical flow. Also the
rendering functions with gsplat's arguments.
"""
