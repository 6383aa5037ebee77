"""Inter-process communication of the service: runtime folder and socket messages."""
