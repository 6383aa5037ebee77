"""Complete settings of the service."""

from __future__ import annotations

import os
import tempfile
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from services.settings.addresses import masked_address
from services.settings.sections import (
    AuditSettings,
    AuthSettings,
    JobSettings,
    LimitSettings,
    LogSettings,
    PathSettings,
    RecordingSettings,
    RegistrySettings,
    ResourceName,
    ServerSettings,
    SourceRules,
    StreamSettings,
)


class ServiceSettings(BaseSettings):
    """Settings of `intrasplat serve`. Later sources win: defaults, file, environment, flags."""

    model_config = SettingsConfigDict(
        env_prefix="INTRASPLAT_", env_nested_delimiter="__", extra="forbid", frozen=True, hide_input_in_errors=True
    )

    version: Literal[1] = Field(default=1, description="Version of this format.")
    server: ServerSettings = ServerSettings()
    paths: PathSettings = PathSettings()
    auth: AuthSettings = AuthSettings()
    audit: AuditSettings = AuditSettings()
    limits: LimitSettings = LimitSettings()
    sources: SourceRules = SourceRules()
    registry: RegistrySettings = RegistrySettings()
    uploaded_recordings: RecordingSettings = RecordingSettings()
    jobs: JobSettings = JobSettings()
    log: LogSettings = LogSettings()
    streams: dict[ResourceName, StreamSettings] = Field(
        default={"endoscope": StreamSettings(source="synthetic:?width=320&height=256&frames=24&moving=1")},
        description="Streams that are there from the start.",
    )

    @model_validator(mode="after")
    def _no_more_streams_than_may_be(self) -> ServiceSettings:
        if len(self.streams) > self.limits.streams:
            raise ValueError(
                f"{len(self.streams)} streams are listed and limits.streams is {self.limits.streams}; raise it"
            )
        return self

    @cached_property
    def data_dir(self) -> Path:
        """Return the folder of all persistent data."""
        return self.paths.data or _base("XDG_DATA_HOME", Path.home() / ".local" / "share") / "intrasplat"

    @cached_property
    def runtime_dir(self) -> Path:
        """Return the folder of the sockets; a short path, because socket paths are limited."""
        if self.paths.runtime is not None:
            return self.paths.runtime
        if os.environ.get("XDG_RUNTIME_DIR"):
            return Path(os.environ["XDG_RUNTIME_DIR"]) / "intrasplat"
        return Path(tempfile.gettempdir()) / f"intrasplat-{os.getuid()}"

    @property
    def admin_key_file(self) -> Path:
        """Return the file of the first administrator's key."""
        return self.auth.admin_key_file or self.data_dir / "admin.key"

    def shown(self) -> dict[str, Any]:
        """Return the settings as JSON, with secrets and passwords in source addresses masked."""
        values = self.model_dump(mode="json")
        for stream in values["streams"].values():
            stream["source"] = masked_address(stream["source"])
        return values


def _base(variable: str, default: Path) -> Path:
    return Path(os.environ[variable]) if os.environ.get(variable) else default
