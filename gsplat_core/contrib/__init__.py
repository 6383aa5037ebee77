"""Experimental parts of gsplat under its names, for training loops of library users."""
