"""Stand-in for gsplat's compiled extension: programs import it to see whether gsplat was built."""

_C = object()
"""Not None, which would mean that there are no compiled kernels. It has no functions."""
