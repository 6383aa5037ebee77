"""Picture distribution to viewers: each picture is encoded once for any number of viewers."""
