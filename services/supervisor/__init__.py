"""The processes of a stream, and who keeps them running."""
