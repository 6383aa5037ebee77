"""Where frames end: videos, pictures, functions."""
