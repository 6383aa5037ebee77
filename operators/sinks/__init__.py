"""Sinks of frames: videos, image files, key frames for the report, session recordings and callbacks."""
