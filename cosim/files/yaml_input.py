"""Reads YAML into frozen dataclasses with type checks; errors name file, field and value."""

import dataclasses
import enum
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import yaml

from cosim.errors import BadInput, Range, hint, inside
from cosim.files.xml_input import regular_file

Config = TypeVar("Config")
Positive = Annotated[float, Range(0.0, above=True)]
NonNegative = Annotated[float, Range(0.0)]
_WANTED = {int: "a whole number", bool: "true or false", str: "text"}


def document(path: Path) -> dict[Any, Any]:
    """The mapping in the YAML file `path`; {} for an empty file.

    Raises BadInput: missing, not UTF-8, not YAML (with the line), no mapping.
    """
    regular_file(path, file=path, field="file")
    try:
        found = yaml.load(path.read_text(encoding="utf-8"), Loader=_OnceOnly)
    except UnicodeDecodeError as error:
        raise BadInput("is not UTF-8", file=path, field="byte", value=error.start) from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = f"not YAML: {getattr(error, 'problem', None) or 'malformed'}"
        line = None if mark is None else mark.line + 1
        raise BadInput(problem, file=path, field="line", value=line) from None
    with inside("file", path):
        return mapping({} if found is None else found)


def check_known(values: Mapping[Any, object], known: Iterable[str]) -> None:
    """Raises BadInput for a field of `values` that is not in `known`, with the nearest known name."""
    names = tuple(known)
    for name in (name for name in values if name not in names):
        raise BadInput(f"unknown field{hint(str(name), names)}", field=str(name), value=values[name])


def read(path: Path, cls: type[Config]) -> Config:
    """The YAML file `path` as an instance of `cls`. Raises BadInput like `document` and `dataclass_from`."""
    return dataclass_from(cls, document(path), path)


def dataclass_from(cls: type[Config], values: object, file: Path | None, where: str = "") -> Config:
    """An instance of `cls` from a mapping parsed from YAML; absent and empty fields keep their defaults.

    Fields may be int, float, bool, str, Literal, IntEnum, X | None, tuples (one value stands for a list of
    one), mappings and dataclasses of these. `Annotated[float, Range(...)]` has bounds; `Any` is not checked.
    `where`: the mapping's name in the file.

    Raises:
        BadInput: an unknown field (with the nearest name), a value of the wrong type, or a value that
            the dataclass refuses.
    """
    with inside(where, file):
        return typing.cast(Config, _instance(cls, mapping(values)))


def value_of(kind: Any, value: object) -> Any:
    """`value`, parsed from YAML, as a `kind`: a type or another annotation of a dataclass field.

    Raises:
        BadInput: wrong type or out of bounds; the error names a field only if it lies inside `value`.
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin in (Union, types.UnionType):
        kind = next(a for a in arguments if a is not type(None))
        return None if value is None else value_of(kind, value)
    if origin is tuple:
        return _tuple(arguments, value)
    if origin is Mapping:
        return {str(name): _part(str(name), arguments[1], v) for name, v in mapping(value).items()}
    if dataclasses.is_dataclass(kind):
        return _instance(kind, mapping(value))
    if kind is float or origin is Annotated:
        return _number(value, arguments[1] if arguments else Range())
    problem = None
    if origin is Literal:
        if value not in arguments:
            names = [*map(str, arguments)]
            problem = f"must be one of {', '.join(names)}{hint(str(value), names)}"
    elif isinstance(kind, type) and issubclass(kind, enum.IntEnum):
        if type(value) is int and value in [*kind]:
            return kind(value)
        problem = f"must be one of {', '.join(f'{m:d} {m.name.lower()}' for m in kind)}"
    elif type(value) is not kind:
        problem = f"{_WANTED[kind]} is needed"
    if problem is not None:
        raise BadInput(problem, value=value)
    return value


def _instance(cls: Any, values: Mapping[Any, object]) -> Any:
    kinds = typing.get_type_hints(cls, include_extras=True)
    fields = {field.name: field for field in dataclasses.fields(cls)}
    given = {}
    check_known(values, fields)
    for name, value in values.items():
        if value is not None or type(None) in get_args(kinds[name]):
            given[name] = _part(name, kinds[name], value)
    for name, field in fields.items():
        if name not in given and field.default is field.default_factory is dataclasses.MISSING:
            raise BadInput("is missing", field=name)
    return cls(**given)


def _part(name: str, kind: Any, value: object) -> Any:
    with inside(name):
        return value_of(kind, value)


def mapping(value: object) -> dict[Any, Any]:
    """`value` if it is a mapping. Raises BadInput."""
    if not isinstance(value, dict):
        raise BadInput("a mapping is needed", value=value)
    return value


def _number(value: object, bounds: Range) -> float:
    problem: str | None = "a finite number is needed"
    if isinstance(value, int | float) and not isinstance(value, bool):
        problem = bounds.problem(value)
        if problem is None:
            return float(value)
    if bounds.high < float("inf"):
        problem = f"a number from {bounds.low:g} to {bounds.high:g} is needed"
    raise BadInput(str(problem), value=value)


def _tuple(kinds: tuple[Any, ...], value: object) -> tuple[Any, ...]:
    if kinds[1:] == (Ellipsis,):
        if not isinstance(value, list | tuple):
            try:
                return (value_of(kinds[0], value),)
            except BadInput as error:
                raise BadInput(f"{error.problem}, or a list", field=error.field, value=error.value) from None
        kinds = kinds[:1] * len(value)
    if not isinstance(value, list | tuple) or len(value) != len(kinds):
        raise BadInput(f"a list of {len(kinds)} values is needed", value=value)
    places = (f"[{i}]" if dataclasses.is_dataclass(kind) else "" for i, kind in enumerate(kinds))
    return tuple(map(_part, places, kinds, value))


class _OnceOnly(yaml.SafeLoader):
    """Refuses duplicate keys in a mapping; YAML would silently keep the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                problem = f"{key.value!r} appears twice in this mapping"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            seen.add(str(key.value))
        return super().construct_mapping(node, deep)
