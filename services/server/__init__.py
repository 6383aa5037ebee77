"""Conversion of an API stream to the specification of its processes."""
