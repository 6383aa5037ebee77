"""The model registry: versioned models, which one is served, and their files (docs/service.md). `models.ModelRegistry` is its door.

Nothing here loads torch but `check`, which runs in a process of its own.
"""
