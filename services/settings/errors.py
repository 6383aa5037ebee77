"""Errors of settings."""

from __future__ import annotations

from gsplat_core.errors import UserError


class SettingsInvalid(UserError, ValueError):
    """A settings file, environment variable or flag is invalid. The message names it and the
    remedy."""
