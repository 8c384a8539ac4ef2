"""The specification of an evaluation: SPEC.yaml and the flags of `cosim evaluate`, read into a `Spec`."""

import glob
import itertools
import math
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sumo_scenarios
from cosim.errors import BadInput, hint, inside
from cosim.files.xml_input import is_there
from cosim.files.yaml_input import check_known, document, value_of
from cosim.scenario import policy_name
from cosim.scenario.options import FLEET, OPTIONS, EpisodeOptions, Option
from cosim.seeding import FIRST_EXAMPLE_SEED

MAX_SEED = 2**62
MAX_EPISODES = 1_000_000  # a larger number is probably a typing error: 3 GB of rows
SEEDS = "seeds"
FIELDS = (*OPTIONS, SEEDS)
_GLOB = re.compile(r"[*?\[]")


@dataclass(frozen=True, slots=True)
class Spec:
    """The axes of the matrix; every combination of one value each is a cell, driven once per seed."""

    values: Mapping[str, tuple[Any, ...]]  # field of `EpisodeOptions` -> its values; others have the default
    seeds: tuple[int, int]  # first, and one past the last

    @property
    def episodes(self) -> int:
        """Number of episodes in the matrix."""
        first, end = self.seeds
        return math.prod(map(len, self.values.values())) * (end - first)

    def options(self) -> Iterator[EpisodeOptions]:
        """The options of every cell, with the first seed."""
        for values in itertools.product(*self.values.values()):
            yield EpisodeOptions(**dict(zip(self.values, values, strict=True)), seed=self.seeds[0])


def read(path: Path | None, flags: Mapping[str, Any]) -> Spec:
    """The spec of a file, of flags, or of both: a flag replaces that axis of the file.

    `flags`: by the names of `Spec`, None if not given; values as typed (`seeds` as "a:b", `demand` as names,
    paths and globs). Paths in the file are relative to the file, paths in flags to the working directory.

    Raises:
        BadInput: unknown field (with the nearest name), wrong kind of value, a glob without a file, invalid
            seeds, values that exclude one another.
    """
    written = {} if path is None else document(path)
    with inside("", path):
        check_known(written, FIELDS)
    given = {name: flags[name] for name in FIELDS if flags.get(name) not in (None, [])}
    if given.keys() & set(FLEET):  # one way to choose the fleet replaces the others
        written = {name: value for name, value in written.items() if name not in FLEET}
    folder = Path(str(path)).absolute().parent
    asked = {name: (v, folder, path, name) for name, v in written.items() if v is not None}
    asked |= {name: (v, Path.cwd(), None, "--" + name.replace("_", "-")) for name, v in given.items()}
    span = asked.pop(SEEDS, None)
    values = {o.field: _values(o, *asked[name]) for name, o in OPTIONS.items() if name in asked}
    source: object = "command line" if path is None else path
    if "what" not in values:
        known = ", ".join(sumo_scenarios.names())
        raise BadInput(f"name at least one: {known}, a folder or a .sumocfg", file=source, field="scenario")
    first = (FIRST_EXAMPLE_SEED, FIRST_EXAMPLE_SEED + 1)
    return _checked(Spec(values, first if span is None else seeds(span[0], *span[2:])), source)


def seeds(text: object, file: object, field: str) -> tuple[int, int]:
    """The first seed and one past the last, of "a:b".

    Raises:
        BadInput: not of that form, or no seed lies between.
    """
    if not isinstance(text, str):
        raise BadInput('write "a:b" in quotes (YAML reads 1:20 as 80)', file=file, field=field, value=text)
    found = re.fullmatch(r"\s*(\d{1,19}):(\d{1,19})\s*", text)
    if found is None:
        raise BadInput("two whole numbers a:b are needed (b excluded)", file=file, field=field, value=text)
    first, end = int(found[1]), int(found[2])
    if end <= first:
        raise BadInput("no seed lies between (b is excluded)", file=file, field=field, value=text)
    if end > MAX_SEED:
        raise BadInput(f"seeds end below {MAX_SEED}", file=file, field=field, value=text)
    return first, end


# ---- inside ----


def _values(option: Option, value: object, folder: Path, file: object, field: str) -> tuple[Any, ...]:
    """The values of one option from what a file or a flag says; files are relative to `folder`."""
    kind: Any = tuple[option.item, ...] if option.axis or option.several else option.kind  # type: ignore[name-defined]
    with inside(field, file):
        given = value_of(kind, value)
        if given == ():
            raise BadInput("the list is empty")
    if option.name in ("scenario", "demand"):
        points = [point for item in given for point in _expand(item, folder, file, field, option.name)]
        found = points if option.several else [point[0] for point in points]
    else:
        found = [option.read(item, folder, field, file) for item in (given if option.axis else [given])]
    return tuple(dict.fromkeys(found))  # no file twice


def _expand(item: str, folder: Path, file: object, field: str, kind: str) -> Iterator[tuple[str, ...]]:
    """The points of one axis from one item.

    A demand may be several files or globs, joined by commas: every combination is a point.
    """
    whole = is_there(folder / item)
    parts = [part.strip() for part in ([item] if whole or kind == "scenario" else item.split(","))]
    return itertools.product(*(_files(part, folder, file, field) for part in parts))


def _files(name: str, folder: Path, file: object, field: str) -> tuple[str, ...]:
    """The matching files, sorted and absolute; a name that is neither file nor glob is unchanged."""
    path = folder / os.path.expanduser(name)
    if sumo_scenarios.ships(name):
        return (name,)
    if is_there(path):
        return (str(path.absolute()),)
    if _GLOB.search(name):
        found = sorted(str(Path(hit).absolute()) for hit in glob.iglob(str(path), recursive=True))
        found = [hit for hit in found if os.path.isfile(hit)]
        if not found:
            raise BadInput("no file matches", file=file, field=field, value=name)
        return tuple(found)
    if "/" in name or name.endswith((".xml", ".gz", ".sumocfg")):
        raise BadInput("no such file", file=file, field=field, value=name)
    return (name,)


def _checked(spec: Spec, file: object) -> Spec:
    """The checks that need no scenario."""
    known = sumo_scenarios.shipped()
    for name in spec.values["what"]:
        if name not in known and not os.path.isabs(name):
            raise BadInput(f"no such scenario{hint(name, known)}", file=file, field="scenario", value=name)
    labels = [policy_name.label(text) for text in spec.values.get("policy", ())]
    if twice := next((name for name in labels if labels.count(name) > 1), None):
        raise BadInput(f"two policies are called {twice}: label them, LABEL=...", file=file, field="policy")
    if spec.episodes > MAX_EPISODES:
        problem = f"{spec.episodes} episodes are more than {MAX_EPISODES}"
        first, end = spec.seeds
        raise BadInput(problem, file=file, field=SEEDS, value=f"{first}:{end}")
    with inside("", file):
        next(spec.options())
    return spec
