"""Declaration of options by annotations of dataclass fields.

A field `name: Annotated[type, Option(...)] = default` of a `Section` is an option. Its values are checked by pydantic when
an object is created. `options_of` returns the declarations of a class, from which interfaces are derived. Importing this
module loads neither torch, NumPy nor pydantic.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
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

from gsplat_core.errors import InvalidSetting
from gsplat_core.registry import Registry

if TYPE_CHECKING:
    from _typeshed import DataclassInstance
    from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler, TypeAdapter, ValidationError
    from pydantic_core import CoreSchema

Command = Literal["replay", "batch", "reconstruct", "live", "job", "stream", "render", "train"]
"""Uses of options: commands of `intrasplat`, replay jobs of the service, and streams of the service. `render` stands for
pictures of a finished model, by `intrasplat render` or through the REST API."""
EVERYWHERE: tuple[Command, ...] = get_args(Command)
_NUMBER = re.compile(r"[0-9]*\.?[0-9]+(?:e-?[0-9]{1,2})?")
MAX_TEXT = 4096
"""Maximum length of the value of a text option, in characters."""


@dataclass(frozen=True, eq=False)
class Names:
    """Annotation of a string option whose values are names in a registry, including names registered at run time.

    Args:
        registry: mapping whose keys are the accepted names.
        addresses: names that must be followed by a colon and an address, with an example of the syntax.
        more: accepted names that are not in the registry.
        weighted: True if a colon and a positive number, the weight, may follow a name.
    """

    registry: Registry[Any] | Mapping[str, Any]
    addresses: Mapping[str, str] = dataclasses.field(default_factory=dict)
    more: tuple[str, ...] = ()
    weighted: bool = False

    @property
    def choices(self) -> list[str]:
        """Return the accepted values; for a name with an address, the example from `addresses`."""
        return [*self.more, *(self.addresses.get(name, name) for name in self.registry)]

    def check(self, value: str) -> str:
        """Check a value given by the user, and return it unchanged.

        Raises:
            ValueError: for an unknown name, a missing address or a superfluous one. The message completes the sentence
            "NAME is VALUE; …".
        """
        name, colon, address = value.partition(":")
        if name in self.addresses and name in self.registry and not address:
            raise ValueError(f"it needs an address: {self.addresses[name]}")
        if self.weighted and name in self.registry and colon and _NUMBER.fullmatch(address) and float(address) > 0:
            return value
        if self.weighted and name in self.registry and colon:
            raise ValueError(f"a positive number follows the colon, as in {name}:0.1")
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
        if self.weighted:
            addressed += [f"^{name}:{_NUMBER.pattern}$" for name in self.registry]
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
        word: spelling of None on the command line, such as "auto"; None if it has no spelling.
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
    """Return the pydantic type of an option's values: strict, without conversions such as true to 1, and with its
    limits."""
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
        return Annotated[kind, BeforeValidator(listed)]
    return Annotated[bool, Field(strict=True)] if kind is bool else kind


def listed(value: Any) -> Any:
    """Split a comma-separated string such as "video,keyframes"; "none" gives an empty tuple. Other types are
    unchanged."""
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
    """Type of the values, without the annotation `Option` and without None."""
    default: Any

    @property
    def choices(self) -> list[str]:
        """Return the accepted values as strings; empty if the option is not restricted to a list."""
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
        """Return the values that must be followed by a colon and a file, each with an example."""
        return next((each.addresses for each in _metadata(self.kind) if isinstance(each, Names)), {})

    def checked(self, value: Any) -> Any:
        """Validate a value of the option and return it, converted from a comma-separated string if the option is a
        tuple.

        Raises:
            InvalidSetting: if the value has another type or is out of range.
        """
        from pydantic import ValidationError

        try:
            return _adapter(self.hint).validate_python(value)
        except ValidationError as error:
            given = f"{value!r:.60}" if self.option.commands else "not valid"  # an address may hold a password
            raise InvalidSetting(f"{self.name} is {given}; {self._expected(error)}") from None

    def json_schema(self) -> dict[str, Any]:
        """Return the JSON schema of the values, with the description."""
        return _adapter(self.hint).json_schema()

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
    """Return the declarations of a class's options by name: first those of the option sections that it inherits, in order, then
    its own and those of its other base classes."""
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
    """Return the type of an option without the annotation `Option` and without None. An annotation `Names` is kept."""
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
    """Base class of option sections, and of the classes that combine sections. Construction validates every option.

    Raises:
        InvalidSetting: if an option has another type or is out of range.
    """

    __pydantic_config__: ClassVar[Any] = {"extra": "forbid"}

    def __post_init__(self) -> None:
        for name, each in options_of(type(self)).items():
            object.__setattr__(self, name, each.checked(getattr(self, name)))

    def chosen(self) -> dict[str, Any]:
        """Return the options that differ from their defaults, as JSON values."""
        values = {name: getattr(self, name) for name in options_of(type(self))}
        changed = {name: value for name, value in values.items() if value != options_of(type(self))[name].default}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in changed.items()}

    def applied_to(self, config: Config) -> Config:
        """Return a copy of `config` in which each field that has the name of an option has the option's value.

        An option of None leaves the field unchanged.
        """
        shared = {field.name for field in dataclasses.fields(config)} & options_of(type(self)).keys()
        given = {name: getattr(self, name) for name in shared if getattr(self, name) is not None}
        return dataclasses.replace(config, **given)

    def options(self, kind: type[Section] | None = None) -> dict[str, Any]:
        """Return the option values by name; if `kind` is given, only of options that `kind` declares."""
        return {name: getattr(self, name) for name in options_of(kind or type(self))}


Kind = TypeVar("Kind", bound=type[Section])


def for_callers(kind: Kind) -> Kind:
    """Restrict the inherited options of a class to the limits of REST API callers. Apply it below `@dataclass`.

    `Option.callers_le` replaces the upper limit of a number. Where an option such as `depth` takes a file, only the
    absolute path of an existing ONNX file on the server is accepted.
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
    """Annotation of an option in which a REST API caller may name an ONNX file on the server."""

    declared: Declared

    def check(self, value: str) -> str:
        """Check a value given by the user, and return it unchanged.

        Raises:
            ValueError: if the value names a file by a relative path, or a file that is not an existing `.onnx` file.
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
