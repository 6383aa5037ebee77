"""Streaming operators for what the video of a real endoscope does: one stage for each fault, one operator that runs any of them in order."""
