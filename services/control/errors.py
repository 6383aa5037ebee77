"""Errors of the server around the application. Those of its answers are in `problems`."""

from gsplat_core.errors import UserError


class CannotServe(UserError):
    """The server cannot listen where, or as, the settings say."""
