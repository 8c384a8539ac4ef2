"""One episode to be driven, as plain data: what makes a result repeatable, and its name in every store."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from typing import Any

from cosim.scenario import Fleet, Scenario, load

KEY_LENGTH = 12  # hexadecimal digits of a cell: 48 bits, a collision among 10,000 cells has odds of 2e-7


@dataclass(frozen=True)
class Case:
    """One episode. Files are absolute paths, worlds and demands of ours are names.

    All cases that differ in nothing but the seed are one `cell`.
    """

    what: str  # a world's name or folder, or a .sumocfg
    demand: tuple[str, ...]  # one demand: names or files that are driven together; () is the scenario's own
    policy: str
    behavior: str | None  # None: the scenario's default
    driver_model: str
    penetration: float | None  # share of AVs; None: the scenario's own fleet
    av_type: str | None
    av_ids: str | None
    svo_deg: float  # degrees
    preset: str | None  # None: the scenario's default
    duration: float | None  # s; None: the scenario's own
    seed: int
    outputs: tuple[str, ...] = ()  # SUMO's own outputs, by SUMO's names

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
        """Plain JSON values; `Case.read` is the way back."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}

    @classmethod
    def read(cls, document: Mapping[str, Any]) -> Case:
        """The case of a `document()`."""
        names = [field.name for field in fields(cls)]
        values: dict[str, Any] = {name: document[name] for name in names if name in document}
        values |= {k: tuple(v) for k, v in values.items() if isinstance(v, list)}
        return cls(**values)

    def with_seed(self, seed: int) -> Case:
        """Another episode of the same cell."""
        return replace(self, seed=seed)

    def scenario(self, options: Sequence[str] = ()) -> Scenario:
        """The scenario as this case wants it, with SUMO `options` as typed after `--`; not vetted.

        Raises:
            BadInput: see `cosim.scenario.load`.
        """
        fleet = None
        if self.av_type is not None or self.av_ids is not None or self.penetration is not None:
            fleet = Fleet(self.av_type, self.av_ids, self.penetration)
        return load(
            self.what,
            demand=self.demand,
            behavior=self.behavior,
            driver_model=self.driver_model,
            preset=self.preset,
            fleet=fleet,
            duration=self.duration,
            options=options,
        )
