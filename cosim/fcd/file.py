"""Reads SUMO's fcd-output as a stream of steps; every number is checked."""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from cosim.errors import BadInput
from cosim.files.xml_input import Progress, chunks, scan
from cosim.scenario.sumocfg import time_of

NUMBERS = ("x", "y", "angle", "speed")  # required attributes of a vehicle
LONGEST_NAME = 1000  # bytes kept from the previous chunk, for a lane name across the boundary


@dataclass(slots=True)
class Row:
    """One vehicle at one step, in SUMO's conventions."""

    id: str
    type: str
    lane: str  # "" if missing
    x: float  # m, front bumper
    y: float  # m
    angle: float  # degrees clockwise from north
    speed: float  # m/s
    pos: float  # m along the lane; NaN if missing


@dataclass(slots=True)
class Step:
    """All vehicles on the road at one time."""

    time: float  # s
    rows: dict[str, Row] = field(default_factory=dict)


def read_steps(path: Path, each: Callable[[Step], None], progress: Progress | None = None) -> None:
    """Call `each` for every timestep of the file, in order, in constant memory.

    Raises:
        BadInput: malformed or truncated, not FCD, a number missing or not finite, a vehicle twice in a step.
    """
    reader = _Reader(path, each)
    scan(path, ("fcd-export",), reader.start, reader.end, unpacked=math.inf, progress=progress)


def lanes_named(path: Path) -> list[str]:
    """The lanes named in the file, sorted. Raises BadInput for an unreadable file."""
    names: set[bytes] = set()
    text = b""
    for chunk in chunks(path, math.inf):
        text = text[-LONGEST_NAME:] + chunk
        names.update(re.findall(rb'\blane="([^"]*)"', text))
    return sorted(name.decode("utf-8", "replace") for name in names if name)


class _Reader:
    """The handlers of one pass."""

    def __init__(self, path: Path, each: Callable[[Step], None]) -> None:
        self._path, self._each = path, each
        self._step: Step | None = None

    def start(self, tag: str, attributes: dict[str, str], line: int) -> None:
        if tag == "timestep":
            text = attributes.get("time", "")
            self._step = Step(time_of(text, self._path, f"timestep.time (line {line})"))
        elif tag == "vehicle":
            if self._step is None:
                raise self._wrong("a vehicle outside of a timestep", "line", line)
            row = self._row(attributes, line)
            if self._step.rows.setdefault(row.id, row) is not row:
                problem = f"appears twice in the step at {self._step.time:g} s (line {line})"
                raise self._wrong(problem, "vehicle.id", row.id)

    def end(self, tag: str) -> None:
        if tag == "timestep" and self._step is not None:
            step, self._step = self._step, None
            self._each(step)

    def _row(self, attributes: dict[str, str], line: int) -> Row:
        if not (name := attributes.get("id")):
            raise self._wrong("is missing", f"vehicle.id (line {line})")
        x, y, angle, speed = (self._number(attributes, n, name, line) for n in NUMBERS)
        lane = attributes.get("lane", "")
        pos = self._number(attributes, "pos", name, line) if lane and "pos" in attributes else math.nan
        return Row(name, attributes.get("type", ""), lane, x, y, angle, speed, pos)

    def _number(self, attributes: Mapping[str, str], name: str, vehicle: str, line: int) -> float:
        text = attributes.get(name)
        if text is None:
            raise self._wrong(f"vehicle {vehicle!r} has none (line {line})", f"vehicle.{name}")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self._wrong(
                f"not a finite number (vehicle {vehicle!r}, line {line})", f"vehicle.{name}", text
            )
        return value

    def _wrong(self, problem: str, place: str, value: object = None) -> BadInput:
        return BadInput(problem, file=self._path, field=place, value=value)
