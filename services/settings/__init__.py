"""Settings of the service, read from a file, the environment and the command line."""

from services.errors import SettingsInvalid
from services.settings.load import ENVIRONMENT_PREFIX, load_settings
from services.settings.sections import ResourceName, ServiceSettings, SourceRules, StreamSettings

__all__ = [
    "ENVIRONMENT_PREFIX",
    "ResourceName",
    "ServiceSettings",
    "SettingsInvalid",
    "SourceRules",
    "StreamSettings",
    "load_settings",
]
