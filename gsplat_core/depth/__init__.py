"""Depth of frames: stereo, parallax, shading and networks, with confidence."""
