"""Read a YAML file field by field: every field is checked, and an error names file, field and value."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from cosim.errors import BadInput, hint, one_of
from cosim.files.xml_input import regular_file


class Section:
    """One mapping of a YAML file; `where` is its dotted name ("" for the file itself).

    Each getter returns its default when the field is absent, and raises BadInput when it is of the wrong
    type or out of range. Fields that are not in `known` are refused with the nearest name.
    """

    def __init__(self, file: Path, values: object, known: Iterable[str], where: str = "") -> None:
        self._file = file
        self._where = where
        if not isinstance(values, dict):
            raise BadInput("a mapping is needed", file=file, field=where or "file", value=values)
        self._values: dict[Any, Any] = values
        allowed = tuple(known)
        for name in values:
            if name not in allowed:
                problem = f"unknown field{hint(str(name), allowed)}"
                raise BadInput(problem, file=file, field=self._name(str(name)), value=values[name])

    def has(self, name: str) -> bool:
        """Whether the field is there and not empty."""
        return self._values.get(name) is not None

    def raw(self, name: str) -> object:
        """The value as YAML read it, for a field with a grammar of its own."""
        return self._values.get(name)

    def text(self, name: str, default: str | None = None) -> str | None:
        """A string."""
        value = self._values.get(name)
        if value is None:
            return default
        if not isinstance(value, str):
            raise self._wrong(name, value, "text is needed")
        return value

    def choice(self, name: str, allowed: Iterable[str], default: str) -> str:
        """One of the words `allowed`."""
        return one_of(self.text(name) or default, allowed, self._name(name), self._file)

    def pattern(self, name: str, default: str | None = None) -> str | None:
        """A regular expression."""
        value = self.text(name, default)
        if value is not None:
            check_pattern(value, self._file, self._name(name))
        return value

    def number(
        self, name: str, default: float | None = None, *, low: float = -math.inf, above: bool = False
    ) -> float | None:
        """A finite number, at least `low` (more than `low` if `above`)."""
        value = self._values.get(name)
        if value is None:
            return default
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise self._wrong(name, value, "a finite number is needed")
        if value < low or (above and value == low):
            bound = f"more than {low:g}" if above else f"at least {low:g}"
            raise self._wrong(name, value, f"must be {bound}")
        return float(value)

    def needed(self, name: str, *, low: float = -math.inf, above: bool = False) -> float:
        """`number`, which must be there."""
        value = self.number(name, low=low, above=above)
        if value is None:
            raise BadInput("missing", file=self._file, field=self._name(name))
        return value

    def keys(self, name: str) -> tuple[str, ...]:
        """The names in the mapping below `name`, of which there must be one."""
        value = self._values.get(name)
        if not isinstance(value, dict) or not value:
            raise self._wrong(name, value, "a mapping is needed")
        return tuple(map(str, value))

    def names(self, name: str) -> tuple[str, ...]:
        """A list of strings; one string stands for a list of one."""
        value = self._values.get(name, ())
        if isinstance(value, str):
            return (value,)
        if not isinstance(value, list | tuple) or not all(isinstance(item, str) for item in value):
            raise self._wrong(name, value, "a list of names is needed")
        return tuple(value)

    def numbers(self, name: str, low: float, high: float) -> tuple[float, ...]:
        """A list of numbers from `low` to `high`; one number stands for a list of one."""
        value = self._values.get(name, ())
        found = value if isinstance(value, list | tuple) else (value,)
        for item in found:
            if isinstance(item, bool) or not isinstance(item, int | float) or not low <= item <= high:
                raise self._wrong(name, item, f"a number from {low:g} to {high:g} is needed")
        return tuple(float(item) for item in found)

    def section(self, name: str, known: Iterable[str]) -> Section:
        """The mapping below `name`; an empty one when it is absent."""
        value = self._values.get(name)
        return Section(self._file, {} if value is None else value, known, self._name(name))

    def sections(self, name: str, known: Iterable[str]) -> tuple[Section, ...]:
        """The list of mappings below `name`."""
        value = self._values.get(name, [])
        if not isinstance(value, list):
            raise self._wrong(name, value, "a list is needed")
        known = tuple(known)
        return tuple(
            Section(self._file, item, known, f"{self._name(name)}[{i}]") for i, item in enumerate(value)
        )

    def _name(self, field: str) -> str:
        return f"{self._where}.{field}" if self._where else field

    def _wrong(self, name: str, value: object, problem: str) -> BadInput:
        return BadInput(problem, file=self._file, field=self._name(name), value=value)


def read(path: Path, known: Iterable[str]) -> Section:
    """The YAML file `path`, which must be one mapping with no fields but `known`.

    Raises:
        BadInput: missing, not UTF-8, not YAML (with the line), or not such a mapping.
    """
    return Section(path, document(path), known)


def document(path: Path) -> object:
    """What the YAML file `path` holds. Raises BadInput: missing, not UTF-8, not YAML (with the line)."""
    regular_file(path, file=path, field="file")
    try:
        return yaml.load(path.read_text(encoding="utf-8"), Loader=_OnceOnly)
    except UnicodeDecodeError as error:
        raise BadInput("is not UTF-8", file=path, field="byte", value=error.start) from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = f"not YAML: {getattr(error, 'problem', None) or 'malformed'}"
        line = None if mark is None else mark.line + 1
        raise BadInput(problem, file=path, field="line", value=line) from None


class _OnceOnly(yaml.SafeLoader):
    """Refuses a key that is twice in a mapping: YAML would keep the last without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                problem = f"{key.value!r} is twice in this mapping"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            seen.add(str(key.value))
        return super().construct_mapping(node, deep)


def check_pattern(pattern: str, file: object, field: str) -> None:
    """Raises BadInput unless `pattern` is a regular expression."""
    try:
        re.compile(pattern)
    except re.error as error:
        raise BadInput(f"not a regular expression: {error}", file=file, field=field, value=pattern) from None
