"""Parameters of human driver and pedestrian errors: rates and magnitudes by kind."""

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

NONE = "none"  # the default: no errors
Probability = Annotated[float, Range(0.0, high=1.0)]
Span = tuple[NonNegative, NonNegative]  # minimum and maximum of a uniform distribution
DIGITS = 8  # hexadecimal digits of a file's digest in its name


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of error. `rate`: probability per trial (driver_errors.md defines the trials)."""

    rate: Probability
    source: str = ""  # of the rate

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, tuple) and value[0] > value[1]:
                raise BadInput("the first must not exceed the second", field=field.name, value=list(value))


@dataclass(frozen=True, slots=True)
class Inattention(Kind):
    """The driver holds speed and lane and sees no other vehicle. Trial: a second within 100 m of a leader."""

    duration: Span = (1.0, 3.0)  # s


@dataclass(frozen=True, slots=True)
class HardBraking(Kind):
    """The driver brakes for no reason. Trial: a second of driving."""

    deceleration: Span = (4.0, 7.0)  # m/s2
    duration: Span = (0.8, 1.6)  # s


@dataclass(frozen=True, slots=True)
class CutIn(Kind):
    """The driver changes lanes although the new follower must brake hard. Trial: a second at such a gap."""

    deceleration: Span = (3.0, 8.0)  # m/s2, required of the new follower


@dataclass(frozen=True, slots=True)
class AbortedCutIn(CutIn):
    """A cut-in after which the driver swerves back at once. Trial: as for a cut-in."""


@dataclass(frozen=True, slots=True)
class ForcedEntry(Kind):
    """The driver enters although it must wait. Trial: a second at the stop line, or near the lane end, with
    an acceptable gap. The probability is `rate` times the seconds waited beyond `patience`."""

    patience: NonNegative = 3.0  # s
    zone: Positive = 150.0  # m before the lane end, in which the driver wants to change lanes
    lag: NonNegative = 0.5  # s, shortest accepted time until the conflicting vehicle arrives


@dataclass(frozen=True, slots=True)
class FailureToYield(Kind):
    """The driver overlooks the vehicles with right of way. Trial: an approach to a yield line."""


@dataclass(frozen=True, slots=True)
class RedLight(Kind):
    """The driver enters on red. Trial: an approach at yellow with an arrival at most `late` after red."""

    late: Positive = 2.0  # s


@dataclass(frozen=True, slots=True)
class StalledCar(Kind):
    """The driver stops in the lane. Trial: a second of driving."""

    deceleration: Span = (2.0, 4.0)  # m/s2
    duration: Span = (30.0, 120.0)  # s, of the standstill


@dataclass(frozen=True, slots=True)
class StepOut(Kind):
    """A person walks onto the crossing without waiting. Trial: a second of waiting there."""

    duration: Span = (3.0, 6.0)  # s in which the person ignores vehicles and signals


@dataclass(frozen=True, slots=True)
class Kinds:
    """One level: its kinds of errors by name; None: absent."""

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
    """A shipped level or a user's file."""

    name: str  # of the level; of a file: stem and first digits of the digest
    digest: str  # SHA-256 of the rates and magnitudes
    kinds: Kinds
    file: Path


def read(
    what: str | None, field: str = "--errors", file: object = None, *, scenario: str = ""
) -> Errors | None:
    """The errors of a shipped level or of a user's YAML file (a table of kinds); None: no errors.

    `field`, `file`: origin of `what`; `scenario`: see `levels`. Raises BadInput naming file, field and value.
    """
    if what is None or what == NONE:
        return None
    shipped = levels(scenario)
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
    """`what` independent of the working directory: a level's name, or a file's absolute path (relative paths
    start at `folder`); None for no errors. Raises BadInput as `read`."""
    path = os.path.abspath(folder / what)
    found = path if what not in (NONE, *levels()) and is_there(Path(path)) else what
    return None if read(found, field, file) is None else found


@lru_cache
def levels(scenario: str = "") -> dict[str, Errors]:
    """The shipped levels by name, as they apply in the shipped scenario `scenario`.

    A table `LEVEL.SCENARIO` of the file replaces kinds of `LEVEL` there. Raises BadInput.
    """
    file = sumo_scenarios.ERRORS
    tables = yaml_input.document(file)
    found = {
        name: yaml_input.dataclass_from(Kinds, table | tables.get(f"{name}.{scenario}", {}), file, name)
        for name, table in tables.items()
        if "." not in name
    }
    return {name: Errors(name, _digest(kinds), kinds, file) for name, kinds in found.items()}


def _digest(kinds: Kinds) -> str:
    """SHA-256 of rates and magnitudes, independent of sources, comments and the order of a file."""
    plain = {kind: values for kind, values in asdict(kinds).items() if values is not None}
    for values in plain.values():
        del values["source"]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()
