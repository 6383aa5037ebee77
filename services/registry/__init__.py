"""Model registry: versioned models, their files and the served version (docs/service.md).
`models.ModelRegistry` is the entry point.

Only `check` imports torch, and it runs in a separate process.
"""
