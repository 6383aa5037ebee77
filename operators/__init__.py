"""Operators of the frame path, the graph that runs them, and the applications that are made of them."""
