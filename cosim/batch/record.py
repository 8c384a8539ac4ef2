"""`cosim record`: drives episodes on worker processes and keeps what every vehicle did."""

from __future__ import annotations

import hashlib
import itertools
import math
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from cosim.episode import Episode
from cosim.errors import BadInput
from cosim.policies import check
from cosim.recording import Folder, RecordingSimulator, write
from cosim.runner import Runner
from cosim.scenario import Scenario, place
from cosim.scenario.episode_id import Case
from cosim.scenario.manifest import manifest
from cosim.scenario.policy_name import read
from cosim.scenario.vet import vetted
from cosim.workers.engines import LocalEngine
from cosim.workers.progress import Progress
from cosim.workers.tasks import Progress as Heartbeat
from cosim.workers.tasks import Task


def cases(
    scenarios: Sequence[str],
    demands: Sequence[str],
    behaviors: Sequence[str],
    policies: Sequence[str],
    seeds: Iterable[int],
    svo_deg: float = 45.0,
    duration: float | None = None,
) -> list[Case]:
    """Every combination, seed by seed; what is left out is the scenario's own. Raises BadInput."""
    policies = [read(policy).text for policy in policies]
    for policy in policies:
        check(policy)
    found = [
        Case(
            what=place(what),
            demand=(demand,) if demand else (),
            policy=policy,
            behavior=behavior or None,
            driver_model="lc2013",
            penetration=None,
            av_type=None,
            av_ids=None,
            svo_deg=svo_deg,
            preset=None,
            duration=duration,
            seed=0,
        )
        for what, demand, behavior, policy in itertools.product(
            scenarios, demands or [""], behaviors or [""], policies
        )
    ]
    for case in found:
        vetted(case.scenario())
    return [case.with_seed(seed) for seed in seeds for case in dict.fromkeys(found)]


class Recorder:
    """Hosted by an engine's worker: drives episodes of any cell, one after another, and writes them."""

    def __init__(self, folder: str) -> None:
        self._folder = Folder(Path(folder))
        self._cell: str | None = None
        self._runner: RecordingRunner | None = None

    def run(self, *arguments: Any, progress: Heartbeat) -> None:
        """One argument, a Case: drive the episode and write its file."""
        case: Case = arguments[0]
        if case.cell != self._cell or self._runner is None:
            self.close()
            self._runner = RecordingRunner(vetted(case.scenario()), case.policy, math.radians(case.svo_deg))
            self._cell = case.cell
        result = self._runner.run(case.seed, progress)
        simulator = self._runner.simulator
        about = {
            "scenario": result.scenario,
            "demand": result.demand,
            "behavior": result.behavior,
            "policy": result.policy,
            "policy_label": result.label,
            "svo_deg": result.svo_deg,
            "driver_model": result.driver_model,
            "preset": result.preset,
            "seed": result.seed,
            "cell": case.cell,
            "trace_hash": result.trace_hash,
            "road": self._folder.add_road(simulator.road),
        }
        write(self._folder.episode_file(case.key), simulator.tape, about)

    def close(self) -> None:
        """End the simulation."""
        if self._runner is not None:
            self._runner.close()
        self._runner = self._cell = None


class RecordingRunner(Runner):
    """A Runner whose simulator remembers: after `run`, `simulator.tape` holds the episode."""

    def __init__(self, scenario: Scenario, policy: str, svo: float) -> None:
        super().__init__(scenario, policy, svo)
        self.simulator = RecordingSimulator(self._simulator)
        self._episode = Episode(scenario, self.simulator, self._policy.observation)


def record(
    out: Path,
    wanted: Sequence[Case],
    *,
    workers: int = 1,
    resume: bool = False,
    command: Sequence[str] = (),
    quiet: bool = False,
) -> list[str]:
    """Drive the cases into `out`; returns those that could not be driven, with why.

    Episodes that are there already are left out when `resume` is given; without it they are BadInput.
    """
    folder = Folder(out)
    if folder.manifest_file.is_file() and not resume:
        raise BadInput("holds recordings already (--resume continues them)", field="--out", value=str(out))
    folder.prepare()
    document = _manifest(folder, wanted, command)
    folder.write_manifest(document)
    todo = [Task(case.key, case.cell, (case,)) for case in wanted if not folder.has(case.key)]
    failed: dict[str, str | None] = {}
    progress = Progress("record", "episodes", quiet=quiet)
    outcomes = LocalEngine(Recorder, (str(out),), workers=workers).run(todo)
    for done, outcome in enumerate(outcomes, 1):
        if not outcome.ok:
            failed[outcome.key] = outcome.error
        progress(done, len(todo))
    progress.done()
    document["failed"] = failed
    document["episodes"] = {key: _digest(folder.episode_file(key)) for key in folder.episodes()}
    folder.write_manifest(document)
    return [f"{key}: {why}" for key, why in failed.items()]


def _manifest(folder: Folder, wanted: Sequence[Case], command: Sequence[str]) -> dict[str, Any]:
    """What is recorded from what; joined with what an earlier call left. Raises BadInput when the files of a
    cell have changed since."""
    before: dict[str, Any] = folder.manifest() if folder.manifest_file.is_file() else {}
    known = dict(before.get("cells", {}))
    for case in {case.cell: case for case in wanted}.values():
        about = manifest(case.scenario(), 0)
        del about["seed"]
        if case.cell in known and known[case.cell]["manifest"]["files"] != about["files"]:
            problem = "was recorded from other scenario files: record into a new folder"
            raise BadInput(problem, file=folder.path, field="cell", value=case.cell)
        settings = case.document()
        del settings["seed"]
        known[case.cell] = {"case": settings, "manifest": about}
    return {
        "cells": known,
        "seeds": sorted({*before.get("seeds", ()), *(case.seed for case in wanted)}),
        "commands": [*before.get("commands", ()), list(command) or sys.argv[1:]],
    }


def _digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
