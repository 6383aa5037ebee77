"""Composition of `intrasplat serve`: implements the control plane's protocols with supervisor,
display, registry and console."""
