"""Errors of the server process. API problems are in `problems`."""

from gsplat_core.errors import UserError


class CannotServe(UserError):
    """The server cannot listen as the settings demand."""
