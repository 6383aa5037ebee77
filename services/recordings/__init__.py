"""Uploaded recordings: stored in a folder, checked in a separate process, deleted by age and size."""
