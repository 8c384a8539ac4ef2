"""What to evaluate, as a user writes it: SPEC.yaml and the flags of `cosim evaluate`, read into a `Spec`."""

from __future__ import annotations

import glob
import itertools
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sumo_scenarios
from cosim.errors import BadInput, hint, one_of
from cosim.files import yaml_input
from cosim.files.xml_input import is_there
from cosim.scenario import BEHAVIORS, policy_name
from cosim.scenario.behaviors import DRIVER_MODELS
from cosim.seeding import FIRST_TEST_SEED
from cosim.types import Preset

MAX_SEED = 2**62
MAX_EPISODES = 1_000_000  # more is a slip of the keyboard: 3 GB of rows
_GLOB = re.compile(r"[*?\[]")


@dataclass(frozen=True, slots=True)
class Spec:
    """The axes of the matrix; every combination of one value each is a cell, driven once per seed."""

    scenario: tuple[str, ...]  # names of worlds, absolute paths of their folders or of .sumocfg
    seeds: tuple[int, int] = (FIRST_TEST_SEED, FIRST_TEST_SEED + 1)  # first, and one past the last
    demand: tuple[tuple[str, ...], ...] = ((),)  # each: names or files driven together; (): the scenario's
    policy: tuple[str, ...] = ("idm",)  # as `cosim.scenario.policy_name` has it, files absolute
    behavior: tuple[str | None, ...] = (None,)  # None: the scenario's default
    driver_model: tuple[str, ...] = ("lc2013",)
    penetration: tuple[float | None, ...] = (None,)  # None: the scenario's own fleet
    svo: tuple[float, ...] = (45.0,)  # degrees; 45 weighs oneself and the others alike
    preset: tuple[str | None, ...] = (None,)
    av_type: str | None = None
    av_ids: str | None = None
    duration: float | None = None  # s
    output: tuple[str, ...] = ()  # SUMO's outputs to keep, by SUMO's names

    @property
    def episodes(self) -> int:
        """How many episodes the matrix has."""
        first, end = self.seeds
        return (
            len(self.scenario)
            * len(self.demand)
            * len(self.policy)
            * len(self.behavior)
            * len(self.driver_model)
            * len(self.penetration)
            * len(self.svo)
            * len(self.preset)
            * (end - first)
        )


FIELDS = tuple(Spec.__dataclass_fields__)


def read(path: Path | None, flags: Mapping[str, Any]) -> Spec:
    """The spec of a file, of flags, or of both: a flag that is given replaces that axis of the file.

    `flags`: by the names of `Spec`, None where not given; values as typed (`seeds` as "a:b", `demand` as
    names, paths and globs). Relative paths of the file are relative to the file, those of flags to here.

    Raises:
        BadInput: unknown field (with the nearest name), wrong kind of value, a glob without a file, seeds
            that are none, values that exclude one another.
    """
    values: dict[str, Any] = {} if path is None else _file(path)
    place = "command line"
    for name, given in flags.items():
        if given is None or given == []:
            continue
        if name in ("scenario", "demand"):
            values[name] = tuple(_expand(item, Path.cwd(), None, f"--{name}", name) for item in given)
        elif name == "policy":
            values[name] = tuple(policy_name.read(item).text for item in given)
        elif name == "seeds":
            values[name] = seeds(given, None, "--seeds")
        else:
            values[name] = (
                tuple(given) if isinstance(given, Sequence) and not isinstance(given, str) else given
            )
        if name in ("av_type", "av_ids", "penetration"):  # one way to choose the fleet replaces the others
            for other in {"av_type", "av_ids", "penetration"} - {name}:
                if flags.get(other) in (None, []):
                    values.pop(other, None)
    for name in ("scenario", "demand"):
        if name in values:
            values[name] = tuple(itertools.chain.from_iterable(values[name]))
    source: object = place if path is None else path
    if not values.get("scenario"):
        known = ", ".join(sumo_scenarios.names())
        raise BadInput(f"name at least one: {known}, a folder or a .sumocfg", file=source, field="scenario")
    values["scenario"] = tuple(item[0] for item in values["scenario"])
    values |= {name: _unique(values[name]) for name in _AXES if name in values}
    return _checked(Spec(**values), source)


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

_AXES = ("scenario", "demand", "policy", "behavior", "driver_model", "penetration", "svo", "preset", "output")
_Demands = tuple[tuple[str, ...], ...]


def _file(path: Path) -> dict[str, Any]:
    """The fields of SPEC.yaml that are there."""
    top = yaml_input.read(path, FIELDS)
    folder = path.absolute().parent
    values: dict[str, Any] = {}
    for name in FIELDS:
        if not top.has(name):
            continue
        if name in ("scenario", "demand"):
            values[name] = tuple(_expand(item, folder, path, name, name) for item in top.names(name))
        elif name == "policy":
            values[name] = tuple(policy_name.read(item, folder, name, path).text for item in top.names(name))
        elif name == "seeds":
            values[name] = seeds(top.raw(name), path, name)
        elif name == "penetration":
            values[name] = top.numbers(name, 0.0, 1.0)
        elif name == "svo":
            values[name] = top.numbers(name, 0.0, 90.0)
        elif name == "duration":
            values[name] = top.number(name, low=0.0, above=True)
        elif name == "av_type":
            values[name] = top.text(name)
        elif name == "av_ids":
            values[name] = top.pattern(name)
        else:
            values[name] = top.names(name)
        if values[name] == ():
            raise BadInput("the list is empty", file=path, field=name)
    return values


def _expand(item: str, folder: Path, file: object, field: str, kind: str) -> _Demands:
    """The points of one axis that one item stands for.

    A demand may be several files, joined by commas, and each of them a glob: every combination is a point.
    """
    whole = is_there(folder / item)
    parts = [part.strip() for part in ([item] if whole or kind == "scenario" else item.split(","))]
    return tuple(itertools.product(*(_files(part, folder, file, field) for part in parts)))


def _files(name: str, folder: Path, file: object, field: str) -> tuple[str, ...]:
    """The files that match, sorted and absolute; a name that is neither file nor glob stays as it is."""
    path = folder / os.path.expanduser(name)
    if name not in sumo_scenarios.names() and is_there(path):
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
    """What can be said without opening a scenario."""
    known = sumo_scenarios.names()
    for name in spec.scenario:
        if name not in known and not os.path.isabs(name):
            raise BadInput(f"no such scenario{hint(name, known)}", file=file, field="scenario", value=name)
    for behavior in filter(None, spec.behavior):
        one_of(behavior, BEHAVIORS, "behavior", file)
    for model in spec.driver_model:
        one_of(model, DRIVER_MODELS, "driver_model", file)
    for preset in filter(None, spec.preset):
        one_of(preset, Preset.ALL, "preset", file)
    labels = [policy_name.label(text) for text in spec.policy]
    if twice := next((name for name in labels if labels.count(name) > 1), None):
        raise BadInput(f"two are called {twice}: label them, LABEL=...", file=file, field="policy")
    chosen = [
        name
        for name, given in (
            ("av_type", spec.av_type),
            ("av_ids", spec.av_ids),
            ("penetration", spec.penetration != (None,) or None),
        )
        if given is not None
    ]
    if len(chosen) > 1:
        raise BadInput(f"excludes {chosen[1]}: give one of them", file=file, field=chosen[0])
    if spec.av_ids is not None:
        yaml_input.check_pattern(spec.av_ids, file, "av_ids")
    if spec.episodes > MAX_EPISODES:
        problem = f"{spec.episodes} episodes are more than {MAX_EPISODES}"
        first, end = spec.seeds
        raise BadInput(problem, file=file, field="seeds", value=f"{first}:{end}")
    return spec


def _unique(values: Sequence[Any]) -> tuple[Any, ...]:
    """Each value once, in the order first given: overlapping globs must not drive a file twice."""
    return tuple(dict.fromkeys(values))
