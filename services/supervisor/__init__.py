"""Capture and engine processes of streams, and their supervision."""
