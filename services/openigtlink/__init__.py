"""A stream's pictures for 3D Slicer, PLUS and others over OpenIGTLink; see docs/exports.md."""
