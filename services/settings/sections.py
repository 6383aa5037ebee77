"""Settings of the service: their sections, and `ServiceSettings` with all of them. Times are in seconds, sizes in bytes."""

from __future__ import annotations

import ipaddress
import os
import re
import tempfile
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, get_args
from urllib.parse import urlsplit

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    SecretStr,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_settings import BaseSettings, SettingsConfigDict

from operators.settings import check_stream_options

_CREDENTIALS = re.compile(r"(?<=://)[^/?#|]*@")
_SECRET_OPTION = re.compile(r"(?i)(?<=[?&#])([^=&#|]*(?:pass|secret|token|ticket|key|auth|sig)[^=&#|]*)=[^&#|]*")
MASK = "**********"


def masked_address(address: str) -> str:
    """Return the address with user, password and tokens masked."""
    return _SECRET_OPTION.sub(rf"\1={MASK}", _CREDENTIALS.sub(f"{MASK}@", address))


MOST = 1e15
MOST_SECONDS = 366 * 86400.0
MOST_DAYS = 36_600.0


class Section(BaseModel):
    """Immutable settings section without unknown keys. Errors do not repeat secrets. Numbers are
    finite, and booleans are not accepted as numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, hide_input_in_errors=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _of_its_kind(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse implicit conversions of pydantic: true as 1, 1 as true, 8000.0 as 8000."""
        kinds = _kinds(cls.model_fields[str(info.field_name)].annotation)
        if isinstance(value, bool) and bool not in kinds and kinds & {int, float}:
            raise ValueError(f"it must be a number, not {str(value).lower()}")
        if isinstance(value, int | float) and not isinstance(value, bool) and bool in kinds:
            raise ValueError(f"it must be true or false, not {value:g}")
        if isinstance(value, float) and int in kinds and float not in kinds:
            raise ValueError(f"it must be a whole number, not {value}")
        return value

    @field_validator("*", mode="after")
    @classmethod
    def _in_bounds(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, int | float) and not isinstance(value, bool):
            name = str(info.field_name)
            most = MOST_SECONDS if name.endswith("_s") and "_per_" not in name else MOST
            most = MOST_DAYS if name.endswith("_days") else most
            if abs(value) > most:
                raise ValueError(f"it must be at most {most:g}")
        return value


def _kinds(annotation: Any) -> set[Any]:
    """Return the classes that an annotation names, those of its unions included."""
    return {annotation, *(kind for each in get_args(annotation) for kind in _kinds(each))}


def _url(text: str) -> str:
    parts = urlsplit(text)
    if parts.scheme == "https" and parts.hostname:
        return text
    if parts.scheme == "http" and parts.hostname and _is_loopback(parts.hostname):
        return text
    raise ValueError(f"{text!r:.100} is no https:// address; http:// is for this machine alone")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


Url = Annotated[str, AfterValidator(_url), Field(examples=["https://login.example/realms/hospital"])]


class OidcSettings(Section):
    """OpenID Connect issuer whose users are admitted in addition to API keys; needs the extra oidc."""

    issuer: Url = Field(description="As the issuer calls itself, to the letter.")
    audience: str = Field(
        min_length=1, description="What tokens for this service have as `aud`.", examples=["intrasplat"]
    )
    roles: dict[str, Literal["viewer", "operator", "admin"]] = Field(
        min_length=1,
        description="Role of each value of the claim; the highest counts, without one a token is refused.",
        examples=[{"theatre-staff": "viewer", "research": "operator"}],
    )
    role_claim: str = Field(
        default="roles", min_length=1, description="Claim with a text or a list, such as groups or realm_access.roles."
    )
    name_claim: str = Field(default="sub", min_length=1, description="Claim by which the audit log names a person.")
    keys_url: Url | None = Field(default=None, description="JWK set. Default: what the issuer's discovery names.")
    algorithms: tuple[
        Literal["RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "EdDSA"], ...
    ] = Field(default=("RS256", "ES256"), min_length=1, description="Algorithms that may have signed a token.")
    ca_file: Path | None = Field(default=None, description="Certificate of the issuer's authority (PEM).")
    leeway_s: float = Field(default=30.0, ge=0, le=300, description="By how much clocks may differ.")


NAME_PATTERN = r"^[a-z0-9][a-z0-9-]{0,39}$"
ResourceName = Annotated[str, Field(pattern=NAME_PATTERN, examples=["theatre-1"])]
"""Name of a stream, model or key: short, and safe in a URL, a file name and a metrics label."""
MIB, GIB = 2**20, 2**30


def _network(text: str) -> str:
    try:
        return str(ipaddress.ip_network(text))
    except ValueError as error:
        raise ValueError(f"{text!r} is no network or address, such as 10.0.0.0/8 or 192.168.1.5") from error


Network = Annotated[str, AfterValidator(_network), Field(examples=["10.0.0.0/8"])]


def _host_pattern(text: str) -> str:
    name = text.lower().rstrip(".")
    if not re.fullmatch(r"(\*\.)?[a-z0-9]([a-z0-9._-]{0,250}[a-z0-9])?", name):
        raise ValueError(f"{text!r:.80} is no name of a host, such as room-1.example, or *.example for all below it")
    return name


HostPattern = Annotated[str, AfterValidator(_host_pattern), Field(examples=["room-1.example"])]


class ServerSettings(Section):
    """Listening address of the API, TLS and proxies."""

    host: str = Field(default="127.0.0.1", description="Address to listen on.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port to listen on; 0 takes any that is free.")
    certfile: Path | None = Field(default=None, description="TLS certificate chain (PEM).")
    keyfile: Path | None = Field(default=None, description="TLS private key (PEM).")
    plaintext: bool = Field(
        default=False, description="Listen beyond this machine without TLS: keys then travel in the clear."
    )
    allowed_hosts: tuple[HostPattern, ...] = Field(
        default=(),
        description="Names by which this server may be asked, such as room-1.example or *.example. Addresses and localhost always may."
        " Without a list: no other name, or with TLS those of the certificate.",
    )
    trusted_proxies: tuple[Network, ...] = Field(
        default=(), description="Whose X-Forwarded-For and X-Forwarded-Proto are believed; nobody's by default."
    )
    probe_host: str = Field(default="127.0.0.1", description="Address of the probe listener.")
    probe_port: int | None = Field(
        default=None,
        ge=0,
        le=65535,
        description="Port of a second listener for /livez and /readyz alone, without TLS and keys, which answers while the first is full."
        " Without it they are at the Unix socket probe.sock in paths.runtime, as always.",
    )
    drain_s: float = Field(default=10.0, ge=0, le=600, description="How long requests may take to end after SIGTERM.")

    @model_validator(mode="after")
    def _whole_pair(self) -> ServerSettings:
        if (self.certfile is None) != (self.keyfile is None):
            raise ValueError("certfile and keyfile belong together; give both or neither")
        return self


class PathSettings(Section):
    """Folders of the service; created if missing, accessible to their owner only."""

    data: Path | None = Field(default=None, description="What is kept. Default: $XDG_DATA_HOME/intrasplat.")
    runtime: Path | None = Field(
        default=None, description="Sockets of running processes. Default: $XDG_RUNTIME_DIR/intrasplat."
    )


class AuthSettings(Section):
    """API keys and tickets."""

    admin_key_file: Path | None = Field(
        default=None,
        description="Holds the first administrator's key: read if it is there, else made at the first start. Default: admin.key in paths.data.",
    )
    ticket_s: float = Field(default=30.0, gt=0, le=300, description="How long a ticket may wait for its one use.")
    oidc: OidcSettings | None = Field(default=None, description="Persons of an OpenID Connect issuer.")


class AuditSettings(Section):
    """Size of audit log segments and their retention. By default segments are kept indefinitely."""

    segment_bytes: int = Field(
        default=16 * MIB, ge=64 * 1024, description="A file that is longer is closed, and the next one goes on."
    )
    keep_segments: int | None = Field(default=None, ge=1, description="Closed files that are kept; null: all.")
    keep_days: float | None = Field(
        default=None,
        gt=0,
        description="A closed file whose last entry is older goes, at the start or when the next is closed.",
    )


class LimitSettings(Section):
    """Resource limits per caller."""

    body_bytes: int = Field(default=MIB, ge=1024, description="Longest body of a request that is not an upload.")
    model_bytes: int = Field(default=2048 * MIB, ge=MIB, description="Longest uploaded model.")
    recording_bytes: int = Field(default=16 * GIB, ge=MIB, description="Longest uploaded recording.")
    uploads: int = Field(default=8, ge=1, le=64, description="Uploads at one time.")
    uploads_per_key: int = Field(
        default=2,
        ge=1,
        le=64,
        description="Uploads of one key at one time: slow ones of one caller leave room for others.",
    )
    stall_s: float = Field(default=10.0, gt=0, description="Longest wait for the next part of a body.")
    slowest_bytes_per_s: int = Field(
        default=4096, ge=0, description="A body that comes slower than this, after the first seconds, is refused."
    )
    head_s: float = Field(default=10.0, gt=0, description="Longest wait for the head of a request.")
    requests_per_s: float = Field(default=100.0, gt=0, description="Requests of one key, on average.")
    address_requests_per_s: float = Field(default=300.0, gt=0, description="Requests of one address, on average.")
    burst_s: float = Field(
        default=2.0, ge=0.1, le=60, description="How many seconds' worth of requests may come at once."
    )
    connections: int = Field(default=512, ge=8, description="Open connections; more are refused.")
    connections_per_address: int = Field(
        default=128,
        ge=0,
        description="Open connections of one address, of IPv6 one /64; more are closed at once. server.trusted_proxies are not counted. 0: no"
        " bound, for a service behind a proxy that has its own.",
    )
    streams: int = Field(default=16, ge=1, le=1000, description="Streams at one time, stopped ones among them.")
    viewers: int = Field(default=100, ge=1, description="Open displays.")
    viewer_stall_s: float = Field(
        default=15.0, gt=0, description="A viewer that takes no picture for so long is dropped."
    )


class SourceRules(Section):
    """Sources that an API caller may use. A stream makes this machine open the address."""

    schemes: tuple[str, ...] = Field(
        default=("synthetic", "rtsp", "rtsps", "v4l2"), description="Schemes of addresses that may be used."
    )
    networks: tuple[Network, ...] = Field(default=(), description="Networks whose addresses may be connected to.")
    hosts: tuple[str, ...] = Field(
        default=(), description="Names of hosts that may be connected to, whatever they resolve to."
    )
    folders: tuple[Path, ...] = Field(default=(), description="Folders whose recordings may be read.")
    devices: tuple[Path, ...] = Field(default=(), description="Video devices that may be opened, such as /dev/video0.")


class RegistrySettings(Section):
    """Storage of models."""

    database: SecretStr | None = Field(
        default=None, description="SQLAlchemy URL. Default: an SQLite file in paths.data."
    )
    blobs: str | None = Field(
        default=None, description="fsspec URL of the models' files. Default: a folder in paths.data."
    )
    blob_options: dict[str, SecretStr] = Field(
        default={}, description="Options of that file system, credentials among them."
    )


class RecordingSettings(Section):
    """Uploaded recordings and their retention. A recording in use is never deleted."""

    folder: Path | None = Field(default=None, description="Where they lie. Default: recordings in paths.data.")
    unpacked_bytes: int = Field(default=64 * GIB, ge=MIB, description="Most that an archive may hold.")
    keep_days: float | None = Field(default=None, gt=0, description="Remove those that are older. Default: never.")
    keep_bytes: int | None = Field(
        default=None, ge=MIB, description="Remove the oldest while all of them take more. Default: never."
    )


class JobSettings(Section):
    """Replay jobs."""

    folder: Path | None = Field(default=None, description="Where results lie. Default: replays in paths.data.")
    workers: int = Field(default=1, ge=1, le=256, description="Replays at one time.")
    threads: int | None = Field(
        default=None, ge=1, le=256, description="Threads of each. Default: half of this machine's, shared among them."
    )
    attempts: int = Field(default=5, ge=1, le=100, description="A job whose process died so often has failed.")
    lease_s: float = Field(
        default=15.0,
        ge=2,
        le=3600,
        description="What a pool that died had claimed is taken by another one after so long.",
    )
    keep_days: float | None = Field(
        default=None, gt=0, description="Remove replays that ended longer ago, with their results. Default: never."
    )
    keep_results: int | None = Field(
        default=None, ge=1, description="Remove the oldest that have ended beyond this number. Default: never."
    )
    ray: str | None = Field(
        default=None, max_length=300, description="Address of a Ray cluster (extra `ray`). Default: this machine."
    )


class LogSettings(Section):
    """Log output on standard error."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    format: Literal["auto", "json", "text"] = Field(
        default="auto", description="`auto` writes text to a terminal and JSON to anything else."
    )


class StreamSettings(Section):
    """Stream that exists from the start."""

    source: str = Field(
        max_length=1000,
        description="Address of the source (docs/sources.md).",
        examples=["synthetic:?width=160&height=128&frames=12"],
    )
    show: str = Field(
        default="live",
        pattern=r"^(live|model [a-z0-9][a-z0-9-]{0,39})$",
        description="`live`, or `model NAME` of the registry.",
    )
    device: str = Field(default="auto", pattern=r"^(auto|cpu|cuda(:\d+)?)$", description="auto, cpu, cuda or cuda:1.")
    start: bool = Field(default=True, description="Start it with the service.")
    options: dict[str, Any] = Field(default={}, description="Options of the source and of the reconstruction.")

    @field_validator("options")
    @classmethod
    def _known_options(cls, options: dict[str, Any]) -> dict[str, Any]:
        check_stream_options(options)
        return options


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
