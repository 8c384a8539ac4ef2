"""Frozen dataclasses from YAML: every field checked by its type, errors name file, field and value."""

from __future__ import annotations

import dataclasses
import enum
import math
import types
import typing
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from cosim.errors import BadInput, hint

Config = TypeVar("Config")


def dataclass_from(cls: type[Config], values: object, file: Path | None, where: str = "") -> Config:
    """An instance of `cls` from a mapping as YAML gives it; absent fields keep their defaults.

    Fields may be int, float, bool, str, Literal, X | None, tuples of these, and further dataclasses.

    Raises:
        BadInput: an unknown field (with the nearest name), a value of the wrong type, or what the
            dataclass itself refuses.
    """
    if not isinstance(values, dict):
        raise BadInput("a mapping is needed", file=file, field=where or "file", value=values)
    hints = typing.get_type_hints(cls)
    names = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
    for name in values:
        if name not in names:
            problem = f"unknown field{hint(str(name), names)}"
            raise BadInput(problem, file=file, field=_dotted(where, str(name)), value=values[name])
    given = {name: _value(hints[name], value, file, _dotted(where, name)) for name, value in values.items()}
    try:
        return cls(**given)
    except TypeError:
        missing = [
            f.name
            for f in dataclasses.fields(cls)  # type: ignore[arg-type]
            if f.name not in given and f.default is f.default_factory is dataclasses.MISSING
        ]
        raise BadInput("is missing", file=file, field=_dotted(where, missing[0]), value=None) from None
    except BadInput as error:
        raise BadInput(
            error.problem, file=file, field=_dotted(where, str(error.field)), value=error.value
        ) from None


def _value(kind: Any, value: object, file: Path | None, where: str) -> Any:
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _value(next(a for a in arguments if a is not type(None)), value, file, where)
    if origin is Literal:
        if value not in arguments:
            problem = (
                f"must be one of {', '.join(map(str, arguments))}{hint(str(value), map(str, arguments))}"
            )
            raise BadInput(problem, file=file, field=where, value=value)
        return value
    if origin is tuple:
        return _tuple(arguments, value, file, where)
    if dataclasses.is_dataclass(kind):
        return dataclass_from(typing.cast(type, kind), value, file, where)
    if kind is float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise BadInput("a finite number is needed", file=file, field=where, value=value)
        return float(value)
    if isinstance(kind, type) and issubclass(kind, enum.IntEnum):
        if isinstance(value, bool) or not isinstance(value, int) or value not in [*kind]:
            names = ", ".join(f"{int(member)} {member.name.lower()}" for member in kind)
            raise BadInput(f"must be one of {names}", file=file, field=where, value=value)
        return kind(value)
    wanted = {int: "a whole number", bool: "true or false", str: "text"}
    if kind not in wanted:
        raise TypeError(f"{where}: fields of type {kind} cannot be read from YAML")
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise BadInput(f"{wanted[kind]} is needed", file=file, field=where, value=value)
    return value


def _tuple(arguments: tuple[Any, ...], value: object, file: Path | None, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise BadInput("a list is needed", file=file, field=where, value=value)
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(value) != len(arguments):
        raise BadInput(f"{len(arguments)} values are needed", file=file, field=where, value=value)
    return tuple(
        _value(a, v, file, f"{where}[{i}]") for i, (a, v) in enumerate(zip(arguments, value, strict=True))
    )


def _dotted(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name
