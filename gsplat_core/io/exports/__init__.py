"""Export of models to formats of other programs; see docs/exports.md."""
