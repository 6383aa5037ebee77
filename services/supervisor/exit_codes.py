"""How the processes of a stream end."""

FINISHED = 0
FAILED = 1
NO_USE = 2
"""What was asked for cannot be done: the process would end in the same way again."""
