"""Errors of human drivers and of persons as data: how often, when and how much, by kind."""

import hashlib
import json
import os
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import sumo_scenarios
from cosim.errors import BadInput, Range, hint
from cosim.files import yaml_input
from cosim.files.xml_input import is_there
from cosim.files.yaml_input import NonNegative, Positive

NONE = "none"  # the default: nobody errs
Probability = Annotated[float, Range(0.0, high=1.0)]
Span = tuple[NonNegative, NonNegative]  # the least and the most; drawn uniformly between them
DIGITS = 8  # hexadecimal digits of a file's digest in its name


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of error: the probability of every trial (driver_errors.md says what a trial is)."""

    rate: Probability
    source: str = ""  # where the rate is from

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, tuple) and value[0] > value[1]:
                raise BadInput("the first must not exceed the second", field=field.name, value=list(value))


@dataclass(frozen=True, slots=True)
class Inattention(Kind):
    """It keeps its speed and its lane and sees nobody. A trial: a second of driving within 100 m behind
    somebody."""

    duration: Span = (1.0, 3.0)  # s


@dataclass(frozen=True, slots=True)
class HardBraking(Kind):
    """It brakes for no reason. A trial: a second in which it drives."""

    deceleration: Span = (4.0, 7.0)  # m/s2
    duration: Span = (0.8, 1.6)  # s


@dataclass(frozen=True, slots=True)
class CutIn(Kind):
    """It changes lanes though the new follower must brake hard. A trial: a second with such a gap beside."""

    deceleration: Span = (3.0, 8.0)  # m/s2 that the gap asks of the follower


@dataclass(frozen=True, slots=True)
class AbortedCutIn(CutIn):
    """The same, and it swerves back at once. A trial: as of a cut-in."""


@dataclass(frozen=True, slots=True)
class ForcedEntry(Kind):
    """It enters though it must wait. A trial: a second at the line, or near its lane's end, in which the gap
    is one that it takes; the probability is `rate` times the seconds waited beyond `patience`."""

    patience: NonNegative = 3.0  # s
    zone: Positive = 150.0  # m before the end of its lane in which it wants to change
    lag: NonNegative = 0.5  # s: it refuses to enter before somebody who would be there sooner at its speed


@dataclass(frozen=True, slots=True)
class FailureToYield(Kind):
    """It does not see who has the right of way. A trial: an approach to a line where it must give way."""


@dataclass(frozen=True, slots=True)
class RedLight(Kind):
    """It enters late, on red. A trial: an approach at yellow that would be on red by at most so much."""

    late: Positive = 2.0  # s


@dataclass(frozen=True, slots=True)
class StalledCar(Kind):
    """It stops in its lane. A trial: a second in which it drives."""

    deceleration: Span = (2.0, 4.0)  # m/s2
    duration: Span = (30.0, 120.0)  # s, from standing on


@dataclass(frozen=True, slots=True)
class StepOut(Kind):
    """A person walks onto the crossing without waiting. A trial: a second in which it waits there."""

    duration: Span = (3.0, 6.0)  # s in which it waits for nobody


@dataclass(frozen=True, slots=True)
class Kinds:
    """One level: the kinds that happen in it, by their names."""

    inattention: Inattention | None = None
    hard_braking: HardBraking | None = None
    cut_in: CutIn | None = None
    aborted_cut_in: AbortedCutIn | None = None
    forced_entry: ForcedEntry | None = None
    failure_to_yield: FailureToYield | None = None
    red_light: RedLight | None = None
    stalled_car: StalledCar | None = None
    step_out: StepOut | None = None


KINDS = tuple(field.name for field in fields(Kinds))


@dataclass(frozen=True, slots=True)
class Errors:
    """A level by its name, or a user's file."""

    name: str  # the level's; of a file its stem and the beginning of its digest
    digest: str  # SHA-256 of the rates and magnitudes
    kinds: Kinds
    file: Path


def read(what: str | None, field: str = "--errors", file: object = None, *, world: str = "") -> Errors | None:
    """The errors of a level that ships or of a user's YAML file (a table of kinds); None: nobody errs.

    `field` and `file` are where `what` is asked for; `world`: as of `levels`. Raises BadInput naming file,
    field and value.
    """
    if what is None or what == NONE:
        return None
    shipped = levels(world)
    if what in shipped:
        return shipped[what]
    path = Path(what)
    if not is_there(path):
        problem = f"no such level{hint(what, (NONE, *shipped))}, and no such file"
        raise BadInput(problem, file=file, field=field, value=what)
    found = yaml_input.read(path, Kinds)
    digest = _digest(found)
    return Errors(f"{path.stem}-{digest[:DIGITS]}", digest, found, path.absolute())


def asked(what: str, folder: Path = Path(), field: str = "--errors", file: object = None) -> str | None:
    """`what` as it is found from anywhere: a level's name, the absolute path of a file relative to `folder`,
    None for no errors. Raises BadInput as `read`."""
    path = os.path.abspath(folder / what)
    found = path if what not in (NONE, *levels()) and is_there(Path(path)) else what
    return None if read(found, field, file) is None else found


@lru_cache
def levels(world: str = "") -> dict[str, Errors]:
    """The levels that ship by name, as they are in a world that ships.

    A table `LEVEL.WORLD` of the file replaces kinds of `LEVEL` there. Raises BadInput.
    """
    file = sumo_scenarios.ERRORS
    tables = yaml_input.document(file)
    found = {
        name: yaml_input.dataclass_from(Kinds, table | tables.get(f"{name}.{world}", {}), file, name)
        for name, table in tables.items()
        if "." not in name
    }
    return {name: Errors(name, _digest(kinds), kinds, file) for name, kinds in found.items()}


def _digest(kinds: Kinds) -> str:
    """Of what the errors do: not of the sources, comments or the order of a file."""
    plain = {kind: values for kind, values in asdict(kinds).items() if values is not None}
    for values in plain.values():
        del values["source"]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()
