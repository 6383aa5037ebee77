"""Settings of the service: their sections, and their loading from a YAML file, the environment and flags.

Times are in seconds, sizes in bytes. An error message names the origin of the value: line of the file, environment variable or flag. Limits on size,
nesting and aliases are checked before a file is parsed.
"""

from __future__ import annotations

import difflib
import ipaddress
import os
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, get_args
from urllib.parse import urlsplit

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    SecretStr,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_settings import (
    BaseSettings,
    EnvSettingsSource,
    InitSettingsSource,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    SettingsError,
)

from gsplat_core.io.files import read_regular
from operators.settings import check_stream_options
from services.errors import SettingsInvalid

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
    if parts.scheme == "http" and parts.hostname and is_loopback(parts.hostname):
        return text
    raise ValueError(f"{text!r:.100} is no https:// address; http:// is for this machine alone")


def is_loopback(host: str) -> bool:
    """Return True if an address or host name is that of this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


Url = Annotated[str, AfterValidator(_url), Field(examples=["https://login.example/realms/hospital"])]


class OidcSettings(Section):
    """OpenID Connect issuer whose users are admitted in addition to API keys; needs the extra oidc."""

    issuer: Url = Field(description="Issuer URL, exactly as in the issuer's discovery document.")
    audience: str = Field(min_length=1, description="Expected `aud` claim of tokens.", examples=["intrasplat"])
    roles: dict[str, Literal["viewer", "operator", "admin"]] = Field(
        min_length=1,
        description="Role for each value of the roles claim. The highest role applies; a token without a known value is "
        "refused.",
        examples=[{"theatre-staff": "viewer", "research": "operator"}],
    )
    role_claim: str = Field(
        default="roles",
        min_length=1,
        description="Claim with the roles, a text or a list, such as groups or realm_access.roles.",
    )
    name_claim: str = Field(
        default="sub", min_length=1, description="Claim used as the person's name in the audit log."
    )
    keys_url: Url | None = Field(
        default=None, description="URL of the issuer's JWK set. Default: from the issuer's discovery document."
    )
    algorithms: tuple[
        Literal["RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "EdDSA"], ...
    ] = Field(default=("RS256", "ES256"), min_length=1, description="Accepted signature algorithms of tokens.")
    ca_file: Path | None = Field(default=None, description="CA certificate for connections to the issuer (PEM).")
    leeway_s: float = Field(default=30.0, ge=0, le=300, description="Accepted clock difference in seconds.")


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
    """Settings of the API server: listening address, TLS and proxies."""

    host: str = Field(default="127.0.0.1", description="Address to listen on.")
    port: int = Field(default=8000, ge=0, le=65535, description="Port to listen on; 0 selects a free port.")
    certfile: Path | None = Field(default=None, description="TLS certificate chain (PEM).")
    keyfile: Path | None = Field(default=None, description="TLS private key (PEM).")
    plaintext: bool = Field(
        default=False, description="Allow addresses beyond this machine without TLS. Keys are then sent unencrypted."
    )
    allowed_hosts: tuple[HostPattern, ...] = Field(
        default=(),
        description="Accepted host names in requests, such as room-1.example or *.example. IP addresses and localhost are "
        "always accepted. Default: the names in the TLS certificate, or none without TLS.",
    )
    trusted_proxies: tuple[Network, ...] = Field(
        default=(),
        description="Addresses of proxies whose X-Forwarded-For and X-Forwarded-Proto headers are used. Default: none.",
    )
    probe_host: str = Field(default="127.0.0.1", description="Address of the probe listener.")
    probe_port: int | None = Field(
        default=None,
        ge=0,
        le=65535,
        description="Port of a second listener for /livez and /readyz, without TLS and keys. It answers even when the main "
        "port has reached its connection limit. The Unix socket probe.sock in paths.runtime answers in any case.",
    )
    drain_s: float = Field(
        default=10.0, ge=0, le=600, description="Longest time for running requests to finish after SIGTERM, in seconds."
    )
    takeover_s: float = Field(
        default=0.0,
        ge=0,
        le=3600,
        description="Time in seconds for which streams continue after the server was killed, so that the next server takes them"
        " over. With 0 they end within 2 s. For servers that are restarted automatically.",
    )

    @model_validator(mode="after")
    def _whole_pair(self) -> ServerSettings:
        if (self.certfile is None) != (self.keyfile is None):
            raise ValueError("certfile and keyfile belong together; give both or neither")
        return self


class PathSettings(Section):
    """Folders of the service; created if missing, accessible to their owner only."""

    data: Path | None = Field(default=None, description="Data folder. Default: $XDG_DATA_HOME/intrasplat.")
    runtime: Path | None = Field(
        default=None, description="Folder for the sockets of running processes. Default: $XDG_RUNTIME_DIR/intrasplat."
    )


class AuthSettings(Section):
    """Settings of API keys and tickets."""

    admin_key_file: Path | None = Field(
        default=None,
        description="File with the first administrator's key. It is read if it exists, and created at the first start "
        "otherwise. The `intrasplat ctl` commands read a key file given by --key-file or INTRASPLAT_KEY_FILE. "
        "Default: admin.key in paths.data.",
    )
    ticket_s: float = Field(default=30.0, gt=0, le=300, description="Lifetime of an unused ticket in seconds.")
    oidc: OidcSettings | None = Field(
        default=None, description="OpenID Connect issuer whose tokens are accepted in place of API keys."
    )


class AuditSettings(Section):
    """Size of audit log segments and their retention. By default segments are kept indefinitely."""

    segment_bytes: int = Field(
        default=16 * MIB,
        ge=64 * 1024,
        description="Size in bytes at which a segment of the log is closed and the next one is started.",
    )
    keep_segments: int | None = Field(default=None, ge=1, description="Number of closed segments to keep; null: all.")
    keep_days: float | None = Field(
        default=None,
        gt=0,
        description="Age in days at which a closed segment is deleted, at start or when the next segment is closed. The age is"
        " that of its last entry.",
    )


class LimitSettings(Section):
    """Limits on the resources that one caller of the API may use."""

    body_bytes: int = Field(
        default=MIB, ge=1024, description="Largest body of a request other than an upload, in bytes."
    )
    model_bytes: int = Field(default=2048 * MIB, ge=MIB, description="Largest uploaded model, in bytes.")
    recording_bytes: int = Field(default=16 * GIB, ge=MIB, description="Largest uploaded recording, in bytes.")
    uploads: int = Field(default=8, ge=1, le=64, description="Concurrent uploads.")
    uploads_per_key: int = Field(
        default=2,
        ge=1,
        le=64,
        description="Concurrent uploads per key, so that slow uploads of one caller do not block other callers.",
    )
    stall_s: float = Field(
        default=10.0, gt=0, description="Longest wait for the next part of a request body, in seconds."
    )
    slowest_bytes_per_s: int = Field(
        default=4096,
        ge=0,
        description="Minimum transfer rate of a request body in bytes per second, after the first seconds. Slower uploads are "
        "refused.",
    )
    head_s: float = Field(default=10.0, gt=0, description="Longest wait for the head of a request, in seconds.")
    requests_per_s: float = Field(default=100.0, gt=0, description="Average request rate per key, per second.")
    address_requests_per_s: float = Field(
        default=300.0, gt=0, description="Average request rate per client address, per second."
    )
    burst_s: float = Field(
        default=2.0, ge=0.1, le=60, description="Size of a burst of requests, in seconds of the average rate."
    )
    connections: int = Field(default=512, ge=8, description="Open connections. Further connections are refused.")
    connections_per_address: int = Field(
        default=128,
        ge=0,
        description="Open connections per client address (IPv6: per /64 network). Further connections are closed immediately. "
        "Addresses in server.trusted_proxies are not limited. 0: no limit, for a service behind a proxy with its "
        "own limit.",
    )
    streams: int = Field(default=16, ge=1, le=1000, description="Number of streams, including stopped ones.")
    viewers: int = Field(default=100, ge=1, description="Number of open displays.")
    viewer_stall_s: float = Field(
        default=15.0, gt=0, description="Time in seconds after which a viewer that receives no picture is disconnected."
    )


class SourceRules(Section):
    """Sources that an API caller may use. A stream makes this machine open the address."""

    schemes: tuple[str, ...] = Field(
        default=("synthetic", "rtsp", "rtsps", "v4l2"), description="Allowed schemes of source addresses."
    )
    networks: tuple[Network, ...] = Field(default=(), description="Networks to which sources may connect.")
    hosts: tuple[str, ...] = Field(
        default=(), description="Host names to which sources may connect. The resolved address is not checked."
    )
    folders: tuple[Path, ...] = Field(default=(), description="Folders from which sources may read recordings.")
    devices: tuple[Path, ...] = Field(
        default=(), description="Video devices that sources may open, such as /dev/video0."
    )


class RegistrySettings(Section):
    """Settings of the model registry's storage."""

    database: SecretStr | None = Field(
        default=None, description="SQLAlchemy URL. Default: an SQLite file in paths.data."
    )
    blobs: str | None = Field(
        default=None, description="fsspec URL of the models' files. Default: a folder in paths.data."
    )
    blob_options: dict[str, SecretStr] = Field(
        default={}, description="Options of the fsspec file system, including credentials."
    )


class RecordingSettings(Section):
    """Uploaded recordings and their retention. A recording in use is never deleted."""

    folder: Path | None = Field(
        default=None, description="Folder of the recordings. Default: recordings in paths.data."
    )
    unpacked_bytes: int = Field(default=64 * GIB, ge=MIB, description="Largest unpacked size of an archive, in bytes.")
    keep_days: float | None = Field(
        default=None, gt=0, description="Age in days at which recordings are deleted. Default: never."
    )
    keep_bytes: int | None = Field(
        default=None,
        ge=MIB,
        description="Total size in bytes above which the oldest recordings are deleted. Default: no limit.",
    )


class JobSettings(Section):
    """Settings of replay jobs."""

    folder: Path | None = Field(default=None, description="Folder of the results. Default: replays in paths.data.")
    workers: int = Field(default=1, ge=1, le=256, description="Number of concurrent replays.")
    threads: int | None = Field(
        default=None,
        ge=1,
        le=256,
        description="Threads per replay. Default: half of the machine's cores, divided among the replays.",
    )
    attempts: int = Field(
        default=5, ge=1, le=100, description="Number of attempts. A job fails if its process dies in each of them."
    )
    lease_s: float = Field(
        default=15.0,
        ge=2,
        le=3600,
        description="Lease time of a claim in seconds. When it ends without renewal, another pool takes the job.",
    )
    keep_days: float | None = Field(
        default=None,
        gt=0,
        description="Age in days at which ended replays are deleted with their results. Default: never.",
    )
    keep_results: int | None = Field(
        default=None, ge=1, description="Number of ended replays to keep. The oldest are deleted. Default: no limit."
    )
    ray: str | None = Field(
        default=None, max_length=300, description="Address of a Ray cluster (extra `ray`). Default: this machine."
    )


class LogSettings(Section):
    """Settings of the log on standard error."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    format: Literal["auto", "json", "text"] = Field(
        default="auto", description="Log format. `auto` writes text to a terminal and JSON otherwise."
    )


class GpuSettings(Section):
    """Use of the GPUs by several streams."""

    mps: bool = Field(
        default=False,
        description="Let streams on one GPU compute at the same time, with NVIDIA's Multi-Process Service, instead of in turns. An error of one stream on the GPU then restarts all streams on that GPU.",
    )


class StreamSettings(Section):
    """Settings of a stream that the service creates when it starts."""

    source: str = Field(
        max_length=1000,
        description="Address of the source (docs/sources.md).",
        examples=["synthetic:?width=160&height=128&frames=12"],
    )
    show: str = Field(
        default="live",
        pattern=r"^(live|model [a-z0-9][a-z0-9-]{0,39})$",
        description="Displayed content: `live`, or `model NAME` from the registry.",
    )
    device: str = Field(
        default="auto", pattern=r"^(auto|cpu|cuda(:\d{1,3})?)$", description="Device: auto, cpu, cuda or cuda:N."
    )
    start: bool = Field(default=True, description="Start the stream with the service.")
    options: dict[str, Any] = Field(default={}, description="Options of the source and the reconstruction.")

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

    version: Literal[1] = Field(default=1, description="Version of the settings format.")
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
    gpu: GpuSettings = GpuSettings()
    streams: dict[ResourceName, StreamSettings] = Field(
        default={"endoscope": StreamSettings(source="synthetic:?width=320&height=256&frames=24&moving=1")},
        description="Streams created when the service starts.",
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


MOST_BYTES = 2**20
MOST_NESTING = 16
MOST_VALUES = 100_000
_NAME_TAGS = ("tag:yaml.org,2002:str", "tag:yaml.org,2002:merge")


@dataclass(frozen=True)
class YamlFile:
    """Values of a settings file, with the line number of each key for error messages."""

    values: dict[str, Any]
    lines: dict[tuple[str, ...], int]
    """Line number of each key, by its path of keys. Keys inside lists are not included."""
    name: str

    @classmethod
    def read(cls, path: Path) -> YamlFile:
        """Read a YAML settings file.

        Raises:
            SettingsInvalid: if the file is missing, is not YAML, or repeats a key.
        """
        try:
            data = read_regular(path, MOST_BYTES)
        except OSError as error:
            raise SettingsInvalid(f"{path}: {error.strerror}; give the settings file's path") from error
        try:
            text = data.decode()
        except UnicodeDecodeError as error:
            raise SettingsInvalid(f"{path} is not readable text: {error}") from error
        try:
            values = yaml_value(text)
            root = yaml.compose(text, yaml.SafeLoader)
        except ValueError as error:
            raise SettingsInvalid(f"{path} is not YAML that settings may have: {error}") from error
        lines: dict[tuple[str, ...], int] = {}
        if root is not None:
            _collect(root, (), lines)
        if not isinstance(values or {}, dict):
            raise SettingsInvalid(f"{path} holds a {type(values).__name__}; write `section:` and below it `key: value`")
        return cls(values or {}, lines, path.name)

    def line_of(self, location: tuple[int | str, ...]) -> int | None:
        """Return the line number of a key, or of the nearest enclosing section that is in the file; None without one."""
        for length in range(len(location), 0, -1):
            line = self.lines.get(tuple(str(part) for part in location[:length]))
            if line is not None:
                return line
        return None


def yaml_value(text: str) -> Any:
    """Parse a YAML text. Nesting is limited to MOST_NESTING and the number of values to
    MOST_VALUES, counting each use of an alias. Keys are text.

    Raises:
        ValueError: if the text is not YAML or exceeds a limit; the message has one line.
    """
    try:
        _check_nesting(text)
        root = yaml.compose(text, yaml.SafeLoader)
        if root is not None:
            _count(root, {})
        return yaml.safe_load(text)
    except (yaml.YAMLError, OverflowError, ValueError) as error:  # ValueError: also invalid dates and numbers
        raise ValueError(" ".join(str(error).split())) from error


def _check_nesting(text: str) -> None:
    depth = 0
    for event in yaml.parse(text, yaml.SafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MOST_NESTING:
            line = event.start_mark.line + 1
            raise ValueError(f"line {line}: lists and sections are more than {MOST_NESTING} deep inside each other")


def _count(node: yaml.Node, counted: dict[int, int]) -> int:
    """Return the number of values of a node.

    Raises:
        ValueError: if there are more than MOST_VALUES, or a key or text is not allowed.
    """
    line = node.start_mark.line + 1
    if isinstance(node, yaml.ScalarNode):
        if "\0" in node.value:
            raise ValueError(f"line {line}: {node.value!r:.60} holds a zero byte")
        return 1
    if id(node) in counted:
        if counted[id(node)] < 0:
            raise ValueError(f"line {line}: a value contains itself")
        return counted[id(node)]
    counted[id(node)] = -1
    total = 1
    pairs = node.value if isinstance(node, yaml.MappingNode) else [(None, each) for each in node.value]
    seen: dict[str, int] = {}
    for key, value in pairs:
        if key is not None:
            _check_name(key, seen)
        total += _count(value, counted)
        if total > MOST_VALUES:
            raise ValueError(f"line {line}: it has more than {MOST_VALUES} values")
    counted[id(node)] = total
    return total


def _check_name(key: yaml.Node, seen: dict[str, int]) -> None:
    line = key.start_mark.line + 1
    if not isinstance(key, yaml.ScalarNode) or key.tag not in _NAME_TAGS:
        shown = repr(key.value)[:60] if isinstance(key, yaml.ScalarNode) else "a list or a section"
        raise ValueError(f"line {line}: {shown} is not text; names in sections are text, put it in quotes")
    if "\0" in key.value:
        raise ValueError(f"line {line}: {key.value!r:.60} holds a zero byte")
    if key.value in seen:
        raise ValueError(f"line {line}: {key.value[:60]!r} occurs twice, first in line {seen[key.value]}")
    seen[key.value] = line


def _collect(node: yaml.Node, place: tuple[str, ...], lines: dict[tuple[str, ...], int]) -> None:
    if not isinstance(node, yaml.MappingNode):
        return
    for key, value in node.value:
        here = (*place, str(key.value))
        lines[here] = key.start_mark.line + 1
        _collect(value, here, lines)


ENVIRONMENT_PREFIX = "INTRASPLAT_"
Location = tuple[int | str, ...]


def load_settings(file: Path | None = None, flags: Mapping[str, str] | None = None) -> ServiceSettings:
    """Load the settings. `file` overrides the defaults, variables such as INTRASPLAT_SERVER__PORT
    override the file, and flags override all.

    Args:
        file: YAML file, or None.
        flags: values by key, such as {"server.port": "8080"}.

    Raises:
        SettingsInvalid: if a key is unknown, a value is out of range, or the file is unreadable.
    """
    document = YamlFile.read(file) if file is not None else YamlFile({}, {}, "")
    given = _nested(flags or {})
    _refuse_unknown_variables()

    class Settings(ServiceSettings):
        @classmethod
        def settings_customise_sources(
            cls, settings_cls: type[BaseSettings], *_: Any, **__: Any
        ) -> tuple[PydanticBaseSettingsSource, ...]:
            return (
                InitSettingsSource(settings_cls, given),
                EnvSettingsSource(settings_cls),
                InitSettingsSource(settings_cls, document.values),
            )

    try:
        return ServiceSettings.model_construct(**dict(Settings()))
    except SettingsError as error:
        raise SettingsInvalid(f"the environment: {error}; give lists and tables as JSON") from error
    except RecursionError as error:
        raise SettingsInvalid("the environment: a value nests lists or tables too deep") from error
    except ValidationError as error:
        said = [_sentence(one["loc"], one, document, flags or {}) for one in error.errors(include_input=False)]
        raise SettingsInvalid("\n".join(said)) from None


def _nested(flags: Mapping[str, str]) -> dict[str, Any]:
    """Convert `{"server.port": "1"}` to `{"server": {"port": "1"}}`; values are parsed as YAML."""
    values: dict[str, Any] = {}
    for name, text in flags.items():
        *sections, key = name.split(".")
        place = values
        for section in sections:
            place = place.setdefault(section, {})
            if not isinstance(place, dict):
                raise SettingsInvalid(f"--set {name}: {section} is given as a value, too; give one of them")
        try:
            place[key] = yaml_value(text)
        except ValueError as error:
            raise SettingsInvalid(f"--set {name}={text!r:.80} is not YAML ({error!s:.120}); quote it") from error
    return values


def _refuse_unknown_variables() -> None:
    """Refuse environment variables with an unknown section, which pydantic-settings would ignore."""
    for variable in sorted(os.environ):
        section = variable.removeprefix(ENVIRONMENT_PREFIX).partition("__")
        if variable.startswith(ENVIRONMENT_PREFIX) and section[1] and section[0].lower() not in _keys(()):
            raise SettingsInvalid(f"{variable}: {_unknown((section[0].lower(),))}")


def _sentence(location: Location, error: Any, document: YamlFile, flags: Mapping[str, str]) -> str:
    what = _unknown(location) if error["type"] == "extra_forbidden" else f"{_dotted(location)}: {error['msg']}"
    return f"{_place(location, document, flags)}{what}"


def _place(location: Location, document: YamlFile, flags: Mapping[str, str]) -> str:
    """Return the origin of an invalid value as a prefix for the error message: flag, environment variable or line of
    the file.
    """
    dotted = _dotted(location)
    for name in flags:
        if dotted == name or dotted.startswith(f"{name}.") or name.startswith(f"{dotted}."):
            return f"--set {name}: "
    for length in range(len(location), 1, -1):
        variable = ENVIRONMENT_PREFIX + "__".join(str(part) for part in location[:length]).upper()
        if variable in {name.upper() for name in os.environ}:
            return f"{variable}: "
    line = document.line_of(location)
    return "" if line is None else f"{document.name}, line {line}: "


def _unknown(location: Location) -> str:
    keys = _keys(location[:-1])
    wrong = str(location[-1])
    near = difflib.get_close_matches(wrong, keys, n=1, cutoff=0.0)
    inside = f" in {_dotted(location[:-1])}" if len(location) > 1 else ""
    return (
        f"there is no key {wrong!r:.60}{inside}; the nearest is {near[0]!r}"
        if near
        else f"there is no key {wrong!r:.60}{inside}"
    )


def _keys(location: Location) -> list[str]:
    """Return the valid keys of the section at a location; none if it is no section."""
    kind: Any = ServiceSettings
    for part in location:
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            field = kind.model_fields.get(str(part))
            kind = None if field is None else _without_none(field.annotation)
        else:
            kind = (get_args(kind) or (None,))[-1]
    return sorted(kind.model_fields) if isinstance(kind, type) and issubclass(kind, BaseModel) else []


def _without_none(kind: Any) -> Any:
    """Return the type without None of a section that may be None."""
    kinds = [each for each in get_args(kind) if each is not type(None)]
    return kinds[0] if len(kinds) == 1 and type(None) in get_args(kind) else kind


def _dotted(location: Location) -> str:
    return ".".join(str(part) for part in location)
