"""One episode to be driven, as plain data: what makes a result repeatable, and its name in every store."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from cosim.errors import BadInput, Range, inside
from cosim.files.yaml_input import dataclass_from, mapping
from cosim.scenario import Scenario, chosen_fleet, load, tilt
from cosim.scenario.behaviors import LC2013
from cosim.scenario.traffic import driven
from cosim.types import Preset

OPTIONAL = (
    "metrics",
    "reward",
    "warmup",
    "mission",
    "on_collision",
    "errors",
    "tilt",
    "traffic",
)  # named only where they are asked for: older keys stay as they are
KEY_LENGTH = 12  # hexadecimal digits of a cell: 48 bits, a collision among 10,000 cells has odds of 2e-7


@dataclass(frozen=True)
class EpisodeId:
    """One episode. Files are absolute paths, worlds and demands of ours are names.

    All cases that differ in nothing but the seed are one `cell`.
    """

    what: str  # a world's name or folder, or a .sumocfg
    policy: str
    seed: int
    demand: tuple[str, ...] = ()  # one demand: names or files driven together; () is the scenario's own
    behavior: str | None = None  # None: the scenario's default
    driver_model: str = LC2013
    penetration: float | None = None  # share of AVs; None: the scenario's own fleet
    av_type: str | None = None
    av_ids: str | None = None
    svo_deg: Annotated[float, Range(0.0, high=90.0)] = 45.0  # degrees
    preset: str | None = None  # None: unguarded, in documents from before presets were always named
    duration: float | None = None  # s; None: the scenario's own
    warmup: float | None = None  # s driven before the counted time; None: the scenario's own
    mission: str | None = None  # id or pattern of the mission vehicle, none, auto; None: the scenario's own
    outputs: tuple[str, ...] = ()  # SUMO's own outputs, by SUMO's names
    metrics: tuple[str, ...] = ()  # measured besides, FILE.py:NAME or MODULE:NAME
    reward: str | None = None  # paid and reported: a name of `cosim.rewards.REWARDS`, or code likewise
    on_collision: str | None = None  # of `OnCollision`; None: the scenario's own
    errors: str | None = None  # of human drivers: a level, or an absolute path; None: none
    tilt: str | None = None  # of these errors (`cosim.scenario.tilt`); None: drawn as they happen
    traffic: str | None = None  # of `Traffic`; None: as `cosim.scenario.traffic` decides

    @cached_property
    def cell(self) -> str:
        """A short stable hash of everything but the seed."""
        return hashlib.sha256(self.text().encode()).hexdigest()[:KEY_LENGTH]

    @property
    def key(self) -> str:
        """Names the episode: unique in every matrix."""
        return f"{self.cell}-{self.seed}"

    def text(self) -> str:
        """Everything but the seed as one line of JSON, always spelled the same."""
        settings = self.document()
        del settings["seed"]
        return json.dumps(settings, sort_keys=True)

    def document(self) -> dict[str, Any]:
        """Plain JSON values; `EpisodeId.read` is the way back."""
        given = {k: v for k, v in asdict(self).items() if v not in (None, ()) or k not in OPTIONAL}
        return {k: list(v) if isinstance(v, tuple) else v for k, v in given.items()}

    @classmethod
    def read(cls, document: object, file: Path | None = None, where: str = "case") -> EpisodeId:
        """The episode of a `document()` that `file` holds under the name `where`.

        Raises BadInput: a field is missing, of another type, or out of its bounds.
        """
        with inside(where, file):
            given = mapping(document)
        names = [field.name for field in fields(cls) if given.get(field.name) is not None]
        found = dataclass_from(cls, {name: given[name] for name in names}, file, where)
        if found.seed < 0:
            problem = "must be a whole number from 0 on"
            raise BadInput(problem, file=file, field=f"{where}.seed", value=found.seed)
        numbers = {name: given[name] for name in names if isinstance(given[name], int | float)}
        return replace(found, **numbers)  # an angle of 45 stays 45: the cell is a hash of its text

    @property
    def drives(self) -> bool:
        """Whether cosim may drive anybody where the scenario's own file does not say so."""
        fleet = chosen_fleet(self.av_type, self.av_ids, self.penetration)
        return bool(driven(fleet, self.behavior, self.errors))

    def with_seed(self, seed: int) -> EpisodeId:
        """Another episode of the same cell."""
        return replace(self, seed=seed)

    def scenario(self, options: Sequence[str] = ()) -> Scenario:
        """The scenario as this case wants it, with SUMO `options` as typed after `--`; not vetted.

        Raises:
            BadInput: see `cosim.scenario.load`.
        """
        found = load(
            self.what,
            demand=self.demand,
            behavior=self.behavior,
            driver_model=self.driver_model,
            preset=self.preset or Preset.UNGUARDED,
            fleet=chosen_fleet(self.av_type, self.av_ids, self.penetration),
            duration=self.duration,
            warmup=self.warmup,
            mission=self.mission,
            on_collision=self.on_collision,
            errors=self.errors,
            traffic=self.traffic,
            options=options,
        )
        return found if self.tilt is None else replace(found, tilt=tilt.read(self.tilt, "tilt"))
