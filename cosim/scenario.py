"""What to simulate: one of our worlds by name, or any user's .sumocfg, read into one `Scenario`."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from cosim.errors import BadInput
from cosim.types import Preset, Timing

MISSIONS = ("merge", "exit", "roundabout", "intersection", "none", "auto")


@dataclass(frozen=True, slots=True)
class Mission:
    """The vehicle that needs somebody's help. `auto`: found from the net while running."""

    kind: str = "auto"
    vehicles: str = ""  # regular expression on vehicle ids; full match
    goal: tuple[str, ...] = ()  # edges; being on one of them is success (off internal lanes)


@dataclass(frozen=True, slots=True)
class Zone:
    """A conflict zone as written in scenario.yaml: edges, internal edges (":J") included."""

    name: str
    edges: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Fleet:
    """Which vehicles are AVs: by vehicle type, by id, or a share of all (the first one given holds)."""

    type: str | None = None
    ids: str | None = None  # regular expression, full match
    penetration: float | None = None  # 0..1, drawn per vehicle id from the seed

    def describe(self) -> str:
        if self.type is not None:
            return f"type {self.type}"
        if self.ids is not None:
            return f"ids {self.ids}"
        return f"penetration {self.penetration:g}" if self.penetration is not None else "none"


@dataclass(frozen=True, slots=True)
class Scenario:
    """Everything the simulator needs; paths are absolute."""

    name: str
    config: Path  # the .sumocfg
    net: Path
    demand: tuple[Path, ...]
    additional: tuple[Path, ...] = ()
    options: tuple[tuple[str, str], ...] = ()  # further SUMO options that change the traffic
    ignored: tuple[str, ...] = ()  # options of the .sumocfg that were not passed on (outputs and such)
    begin: float = 0.0  # s
    warmup: float = 0.0  # s, not counted
    duration: float = 60.0  # s, counted
    timing: Timing = Timing()
    preset: str = Preset.UNGUARDED
    mission: Mission = Mission()
    zones: tuple[Zone, ...] = ()
    fleet: Fleet = Fleet()
    demand_name: str = "as-is"
    behavior: str = "as-is"
    driver_model: str = "lc2013"
    demands: Mapping[str, Path] | None = None  # name -> file, of a built-in world
    title: str = ""

    @property
    def built_in(self) -> bool:
        return self.demands is not None
