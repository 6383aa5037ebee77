"""Models as files for other programs; see docs/exports.md."""
