"""Sinks of frames: videos, images, recordings and callbacks."""
