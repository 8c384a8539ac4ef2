"""The matrix of a spec: every cell is loaded and vetted before the first episode."""

import hashlib
import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cosim.batch.spec import Spec
from cosim.errors import BadInput
from cosim.files import code
from cosim.rewards import read as read_reward
from cosim.scenario import CONFIG, Scenario, sumo_outputs, with_preset
from cosim.scenario.manifest import manifest
from cosim.scenario.options import EpisodeOptions
from cosim.scenario.traffic import driven
from cosim.scenario.vet import vetted
from cosim.types import Traffic
from cosim.workers.tasks import Task

CheckPolicy = Callable[[str], None]  # raises BadInput for an unknown name


@dataclass(frozen=True, slots=True)
class Cell:
    """Cases that differ in the seed only."""

    case: EpisodeOptions  # of the first seed
    scenario: Scenario  # vetted unless `refused`
    manifest: Mapping[str, Any]  # `cosim.scenario.manifest` without the seed
    refused: str | None = None  # reason why the net must not be loaded: all episodes are bad_input

    @property
    def name(self) -> str:
        return self.case.cell

    def task(self, case: EpisodeOptions, outputs: Path | None = None) -> Task:
        """One episode of this cell, for an engine that hosts a `run(case, warnings, outputs)`.

        `outputs`: folder for SUMO's own outputs; None where the case wants none.
        """
        return Task(case.key, self.name, (case, self.scenario.warnings, outputs and str(outputs)))


@dataclass(frozen=True, slots=True)
class Plan:
    """All planned episodes: cells times seeds, in this order."""

    cells: tuple[Cell, ...]
    seeds: range

    @property
    def episodes(self) -> int:
        return len(self.cells) * len(self.seeds)

    @property
    def spec_hash(self) -> str:
        """SHA-256 of the planned episodes, independent of order and notation in the spec."""
        text = json.dumps([sorted(cell.case.text() for cell in self.cells), self.seeds[0], self.seeds[-1]])
        return hashlib.sha256(text.encode()).hexdigest()

    def cases(self) -> Iterator[tuple[Cell, EpisodeOptions]]:
        """Every episode with its cell."""
        for cell, seed in itertools.product(self.cells, self.seeds):
            yield cell, cell.case.with_seed(seed)


def cells(spec: Spec) -> Iterator[EpisodeOptions]:
    """The case of every cell's first seed, without duplicates from policies that have a single preset.

    Cells with and without AVs are compared, so traffic is controlled in all of them if cosim drives in one.
    """
    found = [*dict.fromkeys(map(with_preset, spec.options()))]
    if "traffic" not in spec.values and any(map(drives, found)):
        found = [
            case
            if drives(case) or not case.what.endswith(CONFIG)
            else replace(case, traffic=Traffic.CONTROLLED)
            for case in found
        ]
    yield from found


def drives(case: EpisodeOptions) -> bool:
    """Whether cosim may drive a vehicle that the scenario's own files do not make an AV."""
    return bool(driven(case.fleet, case.behavior, case.errors))


def plan(cases: Iterable[EpisodeOptions], seeds: range, check_policy: CheckPolicy) -> Plan:
    """Load and vet every cell.

    Cells with a net that would crash SUMO become `refused`; the others are driven.

    Raises:
        BadInput: any other fault of a cell: an unknown policy, demand, output or vehicle type, or a demand
            file that is malformed or uses edges outside of the net.
    """
    found = []
    worlds: dict[EpisodeOptions, tuple[Scenario, Mapping[str, Any], str | None]] = {}
    for case in cases:
        check_policy(case.policy)
        for metric in case.metrics:
            code.read(metric, "--metric").load("--metric")
        if case.reward is not None:
            read_reward(case.reward)
        world = replace(case, policy="", svo_deg=0.0, seed=seeds[0])  # independent of the policy
        if world not in worlds:
            worlds[world] = _read(world)
        found.append(Cell(replace(case, seed=seeds[0]), *worlds[world]))
    return Plan(tuple(found), seeds)


def check_names(plan: Plan) -> None:
    """Raises BadInput when two scenarios of the plan have the same name in rows, reports, comparisons."""
    places: dict[str, str] = {}
    for cell in plan.cells:
        name, what = cell.scenario.name, cell.case.what
        if places.setdefault(name, what) != what:
            problem = f"would be called {name}, as {places[name]} is: give the folder another name"
            raise BadInput(problem, field="scenario", value=what)


def _read(case: EpisodeOptions) -> tuple[Scenario, Mapping[str, Any], str | None]:
    """The scenario, vetted unless refused; its manifest without the seed; the reason of a refusal."""
    scenario = case.scenario()
    sumo_outputs.check(case.outputs, scenario.options)
    refused = None
    try:
        scenario = vetted(scenario)
    except BadInput as error:
        if error.file != str(scenario.net):
            raise
        refused = str(error)
    document = manifest(scenario, case.seed)
    del document["seed"]
    return scenario, document, refused
