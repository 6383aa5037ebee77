"""What is wrong with settings."""

from __future__ import annotations

from gsplat_core.errors import UserError


class SettingsInvalid(UserError, ValueError):
    """A settings file, an environment variable or a flag cannot be used; says which, and what to do."""
