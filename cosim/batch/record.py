"""`cosim record`: drives episodes on worker processes and records every vehicle."""

import hashlib
import sys
from pathlib import Path
from typing import Any

from cosim.batch import matrix, spec
from cosim.batch.episode_runner import EpisodeRunner
from cosim.batch.matrix import Plan
from cosim.errors import BadInput
from cosim.policies import check
from cosim.recording.file import write
from cosim.recording.folder import Folder
from cosim.recording.recorder import Recorder
from cosim.scenario.options import EpisodeOptions
from cosim.types import IDENTITY
from cosim.workers.engines import LocalEngine
from cosim.workers.progress import shown
from cosim.workers.tasks import Progress as Heartbeat


def planned(seeds: range, **written: Any) -> Plan:
    """Every combination of options, by the names and kinds of `cosim.batch.spec.read`. Raises BadInput."""
    asked = spec.read(None, written | {spec.SEEDS: f"{seeds.start}:{seeds.stop}"})
    plan = matrix.plan(matrix.cells(asked), seeds, check)
    for cell in plan.cells:
        if cell.refused:
            raise BadInput(cell.refused)
    return plan


class RecordingRunner(EpisodeRunner):
    """Drives episodes of any cell and writes each to the folder."""

    def __init__(self, folder: str) -> None:
        super().__init__()
        self._folder = Folder(Path(folder))

    def run(
        self, case: EpisodeOptions, warnings: tuple[str, ...], outputs: str | None, progress: Heartbeat
    ) -> dict[str, Any]:
        """One episode and its file; the document of `cosim run --json`."""
        host, recorder = self.open(case, warnings), Recorder()
        document = host.run(case.seed, progress, hooks=[recorder]).document()
        about = {name: document[name] for name in (*IDENTITY, "trace_hash")}
        about |= {"cell": case.cell, "road": self._folder.add_road(host.simulator.road)}
        write(self._folder.episode_file(case.key), recorder, about)
        return document


def record(out: Path, plan: Plan, *, workers: int = 1, resume: bool = False) -> list[str]:
    """Record the plan's episodes in `out`; returns failed episodes with their reasons.

    Existing episodes are skipped with `resume`; without it they raise BadInput.
    """
    folder = Folder(out)
    if folder.manifest_file.is_file() and not resume:
        raise BadInput("holds recordings already (--resume continues them)", field="--out", value=str(out))
    folder.prepare()
    document = _manifest(folder, plan)
    folder.write_manifest(document)
    todo = [cell.task(case) for cell, case in plan.cases() if not folder.has(case.key)]
    failed: dict[str, str | None] = {}
    outcomes = LocalEngine(RecordingRunner, (str(out),), workers=workers).run(todo)
    for outcome in shown(outcomes, len(todo), "record", "episodes"):
        if not outcome.ok:
            failed[outcome.key] = outcome.error
    document["failed"] = failed
    document["episodes"] = {key: _digest(folder.episode_file(key)) for key in folder.episodes()}
    folder.write_manifest(document)
    return [f"{key}: {why}" for key, why in failed.items()]


def _manifest(folder: Folder, plan: Plan) -> dict[str, Any]:
    """The sources of the recordings, merged with an earlier manifest. Raises BadInput when the files of a
    cell have changed since."""
    before: dict[str, Any] = folder.manifest() if folder.manifest_file.is_file() else {}
    known = dict(before.get("cells", {}))
    for cell in plan.cells:
        if cell.name in known and known[cell.name]["manifest"]["files"] != cell.manifest["files"]:
            problem = "was recorded from other scenario files: record into a new folder"
            raise BadInput(problem, file=folder.path, field="cell", value=cell.name)
        settings = cell.case.document()
        del settings["seed"]
        known[cell.name] = {"case": settings, "manifest": cell.manifest}
    return {
        "cells": known,
        "seeds": sorted({*before.get("seeds", ()), *plan.seeds}),
        "commands": [*before.get("commands", ()), sys.argv[1:]],
    }


def _digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
