"""Export of models and snapshots to files of other programs, and rendering of models to pictures and videos. Each file is created in
a separate process within limits."""
