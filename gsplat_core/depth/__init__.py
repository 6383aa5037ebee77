"""Depth maps of frames with confidence: from stereo pairs, the parallax of a moving scope, or a user's network.

The package also selects an estimator by name and fits smooth surfaces to depth.
"""
