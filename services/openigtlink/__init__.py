"""OpenIGTLink output of a stream's pictures for 3D Slicer, PLUS and other programs; see
docs/exports.md."""
