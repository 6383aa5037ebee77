"""Options of the engine. Each option is declared once, here.

Sections group the options; `ReplayOptions`, `LiveOptions` and the other classes at the end combine the sections for one use.
An option is a field with its type, range, unit, description and the commands that it applies to. The arguments of
`intrasplat`, the streams of the settings file, the requests of the REST API, stored jobs, the specifications of stream
processes and the forms of the console are derived from these fields.

A new option is one field of a section, and its use in the operator or application that needs it. An option whose name is a
field of `ReconstructorConfig` reaches the reconstructor without further code. Importing this module
loads neither torch, NumPy nor pydantic; values are checked by pydantic when an object is created.
"""

from __future__ import annotations

import dataclasses
import difflib
import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType, NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from gsplat_core.choices import DEPTHS, DEPTHS_WITH_ADDRESS, FIELDS, RENDERERS, Eyes
from gsplat_core.errors import InvalidSetting
from gsplat_core.registry import Registry
from operators.choices import SINKS, TOOL_MASKS, TOOL_MASKS_WITH_ADDRESS, Device, Policy, Poses
from operators.graph.engines import Engine

if TYPE_CHECKING:
    from _typeshed import DataclassInstance
    from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler, TypeAdapter, ValidationError
    from pydantic_core import CoreSchema

Command = Literal["replay", "batch", "reconstruct", "live", "job", "stream"]
"""Uses of options: commands of `intrasplat`, replay jobs of the service, and streams of the service."""
TRAINING_RUNS: tuple[Command, ...] = ("replay", "batch", "reconstruct", "job")
REPLAYS: tuple[Command, ...] = ("replay", "batch", "job")
LIVE: tuple[Command, ...] = ("live", "stream")
COMMANDS: tuple[Command, ...] = (*TRAINING_RUNS, "live")
EVERYWHERE: tuple[Command, ...] = (*TRAINING_RUNS, *LIVE)

MAX_SEED = 2**63 - 1
"""Largest seed that all random generators accept."""
MAX_TEXT = 4096
"""Maximum length of a text, in characters."""


@dataclass(frozen=True, eq=False)
class Names:
    """Annotation of a text that names an entry of a registry. Entries added at run time are accepted.

    Args:
        registry: the entries.
        addresses: entries that are followed by a colon and an address, with an example of the syntax.
        more: accepted names that are not in the registry.
    """

    registry: Registry[Any]
    addresses: Mapping[str, str] = dataclasses.field(default_factory=dict)
    more: tuple[str, ...] = ()

    @property
    def choices(self) -> list[str]:
        """Return the accepted texts; an entry with an address as in `addresses`."""
        return [*self.more, *(self.addresses.get(name, name) for name in self.registry)]

    def check(self, value: str) -> str:
        """Return the value.

        Raises:
            ValueError: for an unknown name, a missing address or a superfluous one; the message continues "NAME is VALUE; ".
        """
        name, colon, address = value.partition(":")
        if name in self.addresses and name in self.registry and not address:
            raise ValueError(f"it needs an address: {self.addresses[name]}")
        if (name in self.registry or name in self.more) and colon and name not in self.addresses:
            raise ValueError(f"nothing follows {name}, write {name!r}")
        if name not in self.registry and value not in self.more:
            raise ValueError(f"choose {_either(self.choices)}")
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        from pydantic_core import core_schema

        return core_schema.no_info_after_validator_function(self.check, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        made = {name: value for name, value in handler(schema).items() if name != "type"}
        plain = [*self.more, *(name for name in self.registry if name not in self.addresses)]
        addressed = [f"^{name}:.+" for name in self.addresses if name in self.registry]
        words = {"type": "string", "enum": plain}
        if not addressed:
            return {**made, **words}
        return {**made, "anyOf": [words, *({"type": "string", "pattern": each} for each in addressed)]}


@dataclass(frozen=True)
class Option:
    """Annotation that declares a field as an option.

    Args:
        description: one plain sentence without a full stop, for help texts, the OpenAPI document and the console.
        commands: uses that the option applies to; empty for a value that the service sets itself.
        unit: unit of the value.
        null: meaning of None, such as "its own".
        word: word of the command line for None, if a value may also be given as a word.
        flag: spelling of a yes-or-no option on the command line; None for `--name`.
        gt, ge, lt, le: range of a number.
        least_length: minimum length of a text.
        callers_le: upper limit for callers of the REST API, if it is lower than `le`.
    """

    description: str
    commands: tuple[Command, ...] = EVERYWHERE
    unit: str | None = None
    null: str | None = None
    word: str | None = None
    flag: str | None = None
    gt: float | None = None
    ge: float | None = None
    lt: float | None = None
    le: float | None = None
    callers_le: float | None = None
    least_length: int | None = None

    @property
    def range(self) -> str:
        """Return the range in words, such as "from 1 to 10"; empty without limits."""
        low, high = ("above", self.gt) if self.gt is not None else ("at least", self.ge), self.lt
        limits = [f"{low[0]} {_number(low[1])}"] if low[1] is not None else []
        if high is not None:
            limits.append(f"below {_number(high)}")
        elif self.le is not None:
            if self.ge is not None and self.gt is None:
                return f"from {_number(self.ge)} to {_number(self.le)}"
            limits.append(f"at most {_number(self.le)}")
        return " and ".join(limits)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        limits = {name: getattr(self, name) for name in ("gt", "ge", "lt", "le") if getattr(self, name) is not None}
        return handler.generate_schema(_strict(source, limits, self.least_length))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        made = {
            **handler(schema),
            "description": f"{self.description}{'' if self.null is None else f'; null: {self.null}'}.",
        }
        return made if self.unit is None else {**made, "x-unit": self.unit}


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"


def _either(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"


def _strict(kind: Any, limits: Mapping[str, Any], least_length: int | None) -> Any:
    """Return a type that pydantic accepts without conversions, such as true for the number 1, and with limits for its
    numbers."""
    from pydantic import BeforeValidator, Field

    if get_origin(kind) in (Union, UnionType):
        return Union[tuple(_strict(each, limits, least_length) for each in get_args(kind))]  # noqa: UP007 - of a computed tuple
    if kind is float:
        return Annotated[float, Field(strict=True, allow_inf_nan=False, **limits)]
    if kind is int:
        return Annotated[int, Field(strict=True, **limits)]
    if kind is str:
        return Annotated[str, Field(min_length=least_length, max_length=MAX_TEXT)]
    if get_origin(kind) is tuple:
        return Annotated[kind, BeforeValidator(_listed)]
    return Annotated[bool, Field(strict=True)] if kind is bool else kind


def _listed(value: Any) -> Any:
    """Return the words of a text such as "video,keyframes", of which "none" means no word."""
    if isinstance(value, str):
        return () if value == "none" else tuple(value.split(","))
    return value


@dataclass(frozen=True)
class Declared:
    """Declaration of one option in a class: its annotation, type and default."""

    name: str
    option: Option
    hint: Any
    kind: Any
    """Type without `Option` and None."""
    default: Any

    @property
    def choices(self) -> list[str]:
        """Return the texts that the option accepts; empty if they are not limited to a list."""
        if get_origin(self.kind) is Literal:
            return [str(each) for each in get_args(self.kind)]
        kind = get_args(self.kind)[0] if get_origin(self.kind) is tuple else self.kind
        return next((each.choices for each in _metadata(kind) if isinstance(each, Names)), [])

    @property
    def plain(self) -> type:
        """Return the type of the value on the command line: int, float, bool or str."""
        return self.kind if self.kind in (int, float, bool) else str

    @property
    def addresses(self) -> Mapping[str, str]:
        """Return the names that are followed by an address, which is a file."""
        return next((each.addresses for each in _metadata(self.kind) if isinstance(each, Names)), {})

    def checked(self, value: Any) -> Any:
        """Return the value as the option has it.

        Raises:
            InvalidSetting: if the value has another type or is out of range.
        """
        from pydantic import ValidationError

        try:
            return _adapter(self.hint).validate_python(value)
        except ValidationError as error:
            given = f"{value!r:.60}" if self.option.commands else "not valid"  # an address may hold a password
            raise InvalidSetting(f"{self.name} is {given}; {self._expected(error)}") from None

    def _expected(self, error: ValidationError) -> str:
        first = error.errors(include_input=False)[0]
        if first["type"] == "value_error":
            return str(first["ctx"]["error"])
        if get_origin(self.kind) is tuple:
            return f"it must be a list of {_either(self.choices)}"
        if self.choices:
            return f"choose {_either(self.choices)}"
        kind = {int: "a whole number", float: "a number", bool: "true or false"}.get(self.kind)
        if kind is None or first["type"] in _OUT_OF_RANGE:
            return f"it must be {self.option.range}" if self.option.range else str(first["msg"])
        return f"it must be {kind}{f' {self.option.range}' if self.option.range else ''}"


_OUT_OF_RANGE = {"greater_than", "greater_than_equal", "less_than", "less_than_equal", "finite_number"}


def _metadata(kind: Any) -> tuple[Any, ...]:
    return getattr(kind, "__metadata__", ())


@cache
def _adapter(hint: Any) -> TypeAdapter[Any]:
    from pydantic import TypeAdapter

    return TypeAdapter(hint)


def options_of(kind: type[Section]) -> Mapping[str, Declared]:
    """Return the options of a class by name: those of its sections in order, then those of combined classes."""
    return _options_of(cast(Any, kind))


@cache
def _options_of(kind: Any) -> Mapping[str, Declared]:
    hints = get_type_hints(kind, include_extras=True)
    defaults = {field.name: field.default for field in dataclasses.fields(kind)}
    classes = sorted(kind.__mro__, key=lambda each: each.__bases__ != (Section,))
    names = dict.fromkeys(name for each in classes for name in inspect.get_annotations(each))
    found = {}
    for name in names:
        option = next((each for each in _metadata(hints[name]) if isinstance(each, Option)), None)
        if option is not None:
            found[name] = Declared(name, option, hints[name], _without_option(hints[name]), defaults[name])
    return MappingProxyType(found)


def _without_option(hint: Any) -> Any:
    """Return the type of an option without its `Option` and without None; a name keeps its `Names`."""
    kind = get_args(hint)[0]
    if get_origin(kind) in (Union, UnionType):
        kinds = [each for each in get_args(kind) if each is not NoneType]
        kind = kinds[0]
    names = [each for each in _metadata(hint) if isinstance(each, Names)]
    return Annotated[kind, names[0]] if names else kind


def options_for(kind: type[Section], command: Command) -> Mapping[str, Declared]:
    """Return the options of a class that apply to a command."""
    return {name: each for name, each in options_of(kind).items() if command in each.option.commands}


Config = TypeVar("Config", bound="DataclassInstance")


@dataclass(frozen=True, kw_only=True)
class Section:
    """Base of the sections and of their combinations.

    Raises:
        InvalidSetting: if an option has another type or is out of range.
    """

    __pydantic_config__: ClassVar[Any] = {"extra": "forbid"}

    def __post_init__(self) -> None:
        for name, each in options_of(type(self)).items():
            object.__setattr__(self, name, each.checked(getattr(self, name)))

    def chosen(self) -> dict[str, Any]:
        """Return the options that differ from their defaults, as values of JSON."""
        values = {name: getattr(self, name) for name in options_of(type(self))}
        changed = {name: value for name, value in values.items() if value != options_of(type(self))[name].default}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in changed.items()}

    def applied_to(self, config: Config) -> Config:
        """Return a dataclass of the core with the values of options that it has fields of the same name for.

        None keeps the value of the field.
        """
        shared = {field.name for field in dataclasses.fields(config)} & options_of(type(self)).keys()
        given = {name: getattr(self, name) for name in shared if getattr(self, name) is not None}
        return dataclasses.replace(config, **given)

    def options(self, kind: type[Section] | None = None) -> dict[str, Any]:
        """Return the options by name; those of the class `kind` alone if one is given."""
        return {name: getattr(self, name) for name in options_of(kind or type(self))}


Scale = Annotated[
    float | None,
    Option(
        "Factor by which the frames are resized",
        null="1; live on a CPU the size that this machine keeps up with",
        gt=0,
        le=64,
        callers_le=4,
    ),
]


@dataclass(frozen=True, kw_only=True)
class SourceSection(Section):
    """Size of the frames."""

    scale: Scale = 1.0

    @property
    def given_scale(self) -> float:
        """Requested scale; 1 if none was given."""
        return 1.0 if self.scale is None else self.scale


@dataclass(frozen=True, kw_only=True)
class LengthSection(Section):
    """Length of a run."""

    max_frames: Annotated[
        int | None,
        Option("Largest number of frames", COMMANDS, null="all", ge=1, le=10**9, callers_le=10_000_000),
    ] = None


Loop = Annotated[bool, Option("Play a recording again and again", LIVE)]


@dataclass(frozen=True, kw_only=True)
class PlaybackSection(Section):
    """Playback of a recording in real time."""

    fps: Annotated[
        float | None,
        Option("Rate at which a recording is played", LIVE, unit="frames/s", null="its own", gt=0, le=1000),
    ] = None
    loop: Loop = False


@dataclass(frozen=True, kw_only=True)
class ReconstructSection(Section):
    """Model and its training."""

    device: Annotated[Device, Option("Processor that trains and renders", COMMANDS)] = "cpu"
    field: Annotated[str, Option("Deformation field; auto is the better one"), Names(FIELDS)] = "auto"
    seed: Annotated[
        int,
        Option(
            "Seed of all random numbers; the same seed gives the same bytes", ge=0, le=MAX_SEED, callers_le=2**31 - 1
        ),
    ] = 0
    eyes: Annotated[Eyes | None, Option("Pictures of a stereo scope that are trained on", null="left")] = None

    @property
    def trained_eyes(self) -> Eyes:
        """Eyes that are trained on. The display shows the left one, and stereo depth uses both in any case."""
        return self.eyes or "left"


@dataclass(frozen=True, kw_only=True)
class DepthSection(Section):
    """Depth and poses of the frames."""

    depth: Annotated[
        str,
        Option(
            "Depth of the frames: stereo from the two eyes, parallax of a moving scope with poses, light of one fixed eye"
            " (relative), onnx by a network of yours (relative)"
        ),
        Names(DEPTHS, DEPTHS_WITH_ADDRESS, ("auto",)),
    ] = "auto"
    poses: Annotated[
        Poses,
        Option(
            "Poses of the scope: given by the recording, or estimated from the pictures (relative; moving tissue looks like a"
            " moving scope)",
            ("replay", "batch", "job", *LIVE),
        ),
    ] = "given"


@dataclass(frozen=True, kw_only=True)
class DisplaySection(Section):
    """Pictures of the model."""

    renderer: Annotated[str, Option("Method that turns Gaussians into a picture"), Names(RENDERERS)] = "alpha"


@dataclass(frozen=True, kw_only=True)
class OutputSection(Section):
    """Files that a run writes beside its report and its model."""

    sinks: Annotated[
        tuple[Annotated[str, Names(SINKS)], ...], Option("Outputs for the report, or none", TRAINING_RUNS)
    ] = (
        "video",
        "keyframes",
    )


@dataclass(frozen=True, kw_only=True)
class ScheduleSection(Section):
    """Work per frame of a replay."""

    steps_per_frame: Annotated[
        int | None,
        Option("Optimiser steps per frame", REPLAYS, null="the field's", ge=1, le=100_000_000, callers_le=10_000),
    ] = None
    heldout: Annotated[
        bool,
        Option(
            "Show frames 1, 9, 17, ... without training on them, and score them separately",
            REPLAYS,
            flag="--heldout/--no-heldout",
        ),
    ] = False
    ignore_schedule: Annotated[
        bool, Option("Replay a recorded session as a plain recording, without its schedule of steps", REPLAYS)
    ] = False


@dataclass(frozen=True, kw_only=True)
class GraphSection(Section):
    """Execution of a replay's graph."""

    engine: Annotated[Engine, Option("Engine that executes the operators", ("replay",))] = "embedded"


@dataclass(frozen=True, kw_only=True)
class OfflineSection(Section):
    """Offline training."""

    steps: Annotated[
        int, Option("Optimiser steps over all training frames", ("reconstruct",), ge=1, le=100_000_000)
    ] = 2000


@dataclass(frozen=True, kw_only=True)
class LiveSection(Section):
    """Checks and clock of a live run."""

    budget_ms: Annotated[
        float | None,
        Option(
            "Time from the arrival of a frame to its picture",
            LIVE,
            unit="ms",
            null="a share of the frame interval",
            word="auto",
            gt=0,
            le=10_000,
        ),
    ] = None
    tool_mask: Annotated[
        str, Option("Tools in frames without a mask", LIVE), Names(TOOL_MASKS, TOOL_MASKS_WITH_ADDRESS)
    ] = "builtin"
    out_of_body: Annotated[
        Policy, Option("Pictures from outside of the body: withhold them, or off to let them pass", LIVE)
    ] = "withhold"


@dataclass(frozen=True, kw_only=True)
class JobOptions(
    ReconstructSection, DepthSection, DisplaySection, SourceSection, LengthSection, ScheduleSection, OutputSection
):
    """Options of a replay job, as stored with the job. A job of `intrasplat batch` may name local files."""


@dataclass(frozen=True, kw_only=True)
class ReplayOptions(JobOptions, GraphSection):
    """Options of `intrasplat replay`."""


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions(JobOptions, OfflineSection):
    """Options of `intrasplat reconstruct`."""


@dataclass(frozen=True, kw_only=True)
class EngineOptions(ReconstructSection, DepthSection, DisplaySection, LiveSection):
    """Options of a live reconstruction, by `intrasplat live` or by a stream's engine process."""


@dataclass(frozen=True, kw_only=True)
class LiveOptions(EngineOptions, SourceSection, LengthSection, PlaybackSection):
    """Options of `intrasplat live`."""

    scale: Scale = None
    seconds: Annotated[
        float | None,
        Option("Duration of the run", ("live",), unit="s", null="until the source ends", gt=0, lt=1e9),
    ] = None


@dataclass(frozen=True, kw_only=True)
class CaptureOptions(SourceSection, PlaybackSection):
    """Options of a stream's capture process."""

    loop: Loop = True


@dataclass(frozen=True, kw_only=True)
class StreamEngineOptions(EngineOptions):
    """Options of a stream's engine process."""

    engine_scale: Annotated[
        float | None,
        Option(
            "Size of the reconstruction relative to the stream's pictures",
            ("stream",),
            null="1; on a CPU the size that keeps up",
            gt=0,
            le=1,
        ),
    ] = None


Kind = TypeVar("Kind", bound=type[Section])


def for_callers(kind: Kind) -> Kind:
    """Decorate a class below `@dataclass`: its options have the limits of callers of the REST API.

    Numbers have the limit `Option.callers_le`. A file of an option such as `depth` must be an ONNX file of this machine,
    named by its absolute path.
    """
    (base,) = kind.__bases__
    for name, each in options_of(base).items():
        annotations: list[Any] = []
        if each.option.callers_le is not None:
            annotations.append(dataclasses.replace(each.option, le=each.option.callers_le))
        if each.addresses:
            annotations += [each.option, ServerFile(each)]
        if annotations:
            kept = [note for note in _metadata(each.hint) if not isinstance(note, Option)]
            kind.__annotations__[name] = Annotated[(get_args(each.hint)[0], *annotations[:1], *kept, *annotations[1:])]
            setattr(kind, name, each.default)
    return kind


@dataclass(frozen=True)
class ServerFile:
    """Annotation of an option of a caller that may name a file of the server."""

    declared: Declared

    def check(self, value: str) -> str:
        """Return the value.

        Raises:
            ValueError: if it names no ONNX file by an absolute path.
        """
        name, _, file = value.partition(":")
        if name not in self.declared.addresses:
            return value
        if not Path(file).is_absolute():
            raise ValueError(f"give the absolute path of a file, as {name}:/models/{self.declared.name}.onnx")
        if not (Path(file).suffix == ".onnx" and Path(file).is_file()):
            raise ValueError(f"{file!r:.200} is no file of the server that ends in .onnx; check the path")
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        from pydantic_core import core_schema

        return core_schema.no_info_after_validator_function(self.check, handler(source))


@dataclass(frozen=True, kw_only=True)
@for_callers
class CallerJobOptions(JobOptions):
    """Options of a replay job that a caller of the REST API asks for."""


@dataclass(frozen=True, kw_only=True)
@for_callers
class CallerCaptureOptions(CaptureOptions):
    """Options of a stream's capture process, with the limits of callers."""


@dataclass(frozen=True, kw_only=True)
@for_callers
class CallerEngineOptions(StreamEngineOptions):
    """Options of a stream's engine process, with the limits of callers."""


def stream_options() -> dict[str, Declared]:
    """Return the options of a stream of the service by name."""
    return {**options_for(CallerCaptureOptions, "stream"), **options_for(CallerEngineOptions, "stream")}


def check_stream_options(options: Mapping[str, Any]) -> None:
    """Check options of a stream, as a settings file or a caller gives them. None stands for the default.

    Raises:
        InvalidSetting: if an option is unknown or out of range.
    """
    known = stream_options()
    for name, value in sorted(options.items()):
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
            raise InvalidSetting(f"a stream has no option {name!r:.60}; the nearest is {near!r}")
        if value is not None:
            known[name].checked(value)


def stream_options_schema() -> dict[str, Any]:
    """Return the JSON schema of a stream's options; each accepts null for its default."""
    properties: dict[str, Any] = {}
    for name, each in stream_options().items():
        schema = _adapter(each.hint).json_schema()
        about = {key: schema.pop(key) for key in ("description", "x-unit") if key in schema}
        kinds = schema.pop("anyOf", [schema])
        kinds = kinds if {"type": "null"} in kinds else [*kinds, {"type": "null"}]
        properties[name] = {"anyOf": kinds, "default": each.default, **about}
    return {"properties": properties, "additionalProperties": False}


def check_option(name: str, value: Any) -> None:
    """Check the value of an option of `replay`, `reconstruct` or `live` by its name.

    Raises:
        InvalidSetting: if it has another type or is out of range.
    """
    known = {**options_of(LiveOptions), **options_of(ReconstructOptions), **options_of(ReplayOptions)}
    known[name].checked(value)
