"""What to evaluate, as a user writes it: SPEC.yaml and the flags of `cosim evaluate`, read into a `Spec`."""

import glob
import itertools
import math
import os
import re
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import sumo_scenarios
from cosim.errors import BadInput, Range, check_pattern, hint, inside, one_of
from cosim.files import code
from cosim.files.xml_input import is_there
from cosim.files.yaml_input import NonNegative, Positive, check_known, document, value_of
from cosim.scenario import BEHAVIORS, human_errors, policy_name
from cosim.scenario.behaviors import DRIVER_MODELS
from cosim.seeding import FIRST_TEST_SEED
from cosim.types import OnCollision, Preset, Traffic

MAX_SEED = 2**62
MAX_EPISODES = 1_000_000  # more is a slip of the keyboard: 3 GB of rows
FLEET = ("av_type", "av_ids", "penetration")  # ways to choose the AVs: one excludes the others
# Axes of the matrix, in the order of its cells -> the field of `EpisodeId` that each value fills.
AXES = {
    "scenario": "what",
    "demand": "demand",
    "behavior": "behavior",
    "driver_model": "driver_model",
    "penetration": "penetration",
    "preset": "preset",
    "errors": "errors",
    "policy": "policy",
    "svo": "svo_deg",
}
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
    penetration: tuple[Annotated[float, Range(0.0, high=1.0)] | None, ...] = (
        None,
    )  # None: the scenario's own fleet
    svo: tuple[Annotated[float, Range(0.0, high=90.0)], ...] = (
        45.0,
    )  # degrees; 45 weighs oneself and the others alike
    preset: tuple[str | None, ...] = (None,)
    errors: tuple[str | None, ...] = (None,)  # of human drivers: levels, absolute paths; None: none
    av_type: str | None = None
    av_ids: str | None = None
    duration: Positive | None = None  # s
    warmup: NonNegative | None = None  # s
    mission: str | None = None  # a vehicle's id or a pattern of ids, none, auto; None: the scenario's own
    output: tuple[str, ...] = ()  # SUMO's outputs to keep, by SUMO's names
    metric: tuple[str, ...] = ()  # measured besides, FILE.py:NAME or MODULE:NAME, files absolute
    on_collision: str | None = None  # of `OnCollision`; None: the scenario's own
    traffic: str | None = None  # of `Traffic`; None: as-is where cosim drives nobody in any cell
    reward: str | None = None  # paid and reported: a name of `cosim.rewards.REWARDS`, or code likewise

    @property
    def episodes(self) -> int:
        """How many episodes the matrix has."""
        first, end = self.seeds
        return math.prod(len(getattr(self, axis)) for axis in AXES) * (end - first)


_KINDS = typing.get_type_hints(Spec, include_extras=True)
FIELDS = tuple(_KINDS)


def read(path: Path | None, flags: Mapping[str, Any]) -> Spec:
    """The spec of a file, of flags, or of both: a flag that is given replaces that axis of the file.

    `flags`: by the names of `Spec`, None where not given; values as typed (`seeds` as "a:b", `demand` as
    names, paths and globs). Relative paths of the file are relative to the file, those of flags to here.

    Raises:
        BadInput: unknown field (with the nearest name), wrong kind of value, a glob without a file, seeds
            that are none, values that exclude one another.
    """
    written = {} if path is None else document(path)
    with inside("", path):
        check_known(written, FIELDS)
    given = {name: flags[name] for name in FIELDS if flags.get(name) not in (None, [])}
    if given.keys() & set(FLEET):  # one way to choose the fleet replaces the others
        written = {name: value for name, value in written.items() if name not in FLEET}
    values = {}
    for name in FIELDS:
        if name in given:
            values[name] = _axis(name, given[name], Path.cwd(), None, f"--{name}")
        elif written.get(name) is not None:
            values[name] = _axis(name, written[name], Path(str(path)).absolute().parent, path, name)
    source: object = "command line" if path is None else path
    if "scenario" not in values:
        known = ", ".join(sumo_scenarios.names())
        raise BadInput(f"name at least one: {known}, a folder or a .sumocfg", file=source, field="scenario")
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


def _axis(name: str, value: object, folder: Path, file: object, field: str) -> Any:
    """A field of the spec from what a file or a flag says; files are relative to `folder`."""
    if name == "seeds":
        return seeds(value, file, field)
    with inside(field, file):
        found = value_of(tuple[str, ...] if name == "demand" else _KINDS[name], value)
        if found == ():
            raise BadInput("the list is empty")
    if name == "policy":
        found = [policy_name.read(item, folder, field, file).text for item in found]
    elif name == "metric":
        found = [code.absolute(item, field, folder=folder, file=file) for item in found]
    elif name == "reward":
        found = code.absolute(found, field, folder=folder, file=file)
    elif name == "errors":
        found = [human_errors.asked(item, folder) for item in found]
        for item in found:
            human_errors.read(item, field, file)
    elif name in ("scenario", "demand"):
        found = [point for item in found for point in _expand(item, folder, file, field, name)]
        found = [point[0] for point in found] if name == "scenario" else found
    return tuple(dict.fromkeys(found)) if isinstance(found, list | tuple) else found  # no file twice


def _expand(item: str, folder: Path, file: object, field: str, kind: str) -> Iterator[tuple[str, ...]]:
    """The points of one axis that one item stands for.

    A demand may be several files, joined by commas, and each of them a glob: every combination is a point.
    """
    whole = is_there(folder / item)
    parts = [part.strip() for part in ([item] if whole or kind == "scenario" else item.split(","))]
    return itertools.product(*(_files(part, folder, file, field) for part in parts))


def _files(name: str, folder: Path, file: object, field: str) -> tuple[str, ...]:
    """The files that match, sorted and absolute; a name that is neither file nor glob stays as it is."""
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
    """What can be said without opening a scenario."""
    known = (*sumo_scenarios.names(), *sumo_scenarios.practice())
    for name in spec.scenario:
        if name not in known and not os.path.isabs(name):
            raise BadInput(f"no such scenario{hint(name, known)}", file=file, field="scenario", value=name)
    words = (("behavior", BEHAVIORS), ("driver_model", DRIVER_MODELS), ("preset", Preset.ALL))
    for field, allowed in words:
        for word in filter(None, getattr(spec, field)):
            one_of(word, allowed, field, file)
    if spec.on_collision is not None:
        one_of(spec.on_collision, OnCollision.ALL, "on_collision", file)
    if spec.traffic is not None:
        one_of(spec.traffic, Traffic.ALL, "traffic", file)
    labels = [policy_name.label(text) for text in spec.policy]
    if twice := next((name for name in labels if labels.count(name) > 1), None):
        raise BadInput(f"two are called {twice}: label them, LABEL=...", file=file, field="policy")
    chosen = [name for name in FLEET if getattr(spec, name) not in (None, (None,))]
    if len(chosen) > 1:
        raise BadInput(f"excludes {chosen[1]}: give one of them", file=file, field=chosen[0])
    if spec.av_ids is not None:
        check_pattern(spec.av_ids, "av_ids", file)
    if spec.episodes > MAX_EPISODES:
        problem = f"{spec.episodes} episodes are more than {MAX_EPISODES}"
        first, end = spec.seeds
        raise BadInput(problem, file=file, field="seeds", value=f"{first}:{end}")
    return spec
