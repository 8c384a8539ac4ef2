"""What evaluation hosts in its worker processes: any case, one after another, in one process."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.scenario.episode_id import Case
from cosim.types import Policy
from cosim.workers.tasks import Progress

if TYPE_CHECKING:
    from cosim.runner import Runner


class CaseRunner:
    """Keeps the simulation of the last case's cell: its next seed costs a reset, another cell a start."""

    def __init__(self) -> None:
        self._runner: Runner | None = None
        self._cell = ""

    def run(
        self, case: Case, warnings: tuple[str, ...], outputs: str | None, progress: Progress
    ) -> dict[str, Any]:
        """One episode; the document of `cosim run --json`.

        `warnings` are those of vetting; SUMO's own outputs go to the folder `outputs`/key.
        """
        runner = self.open(case, warnings)
        folder = None if outputs is None else Path(outputs) / case.key
        return runner.run(case.seed, progress, outputs=case.outputs, folder=folder).document()

    def policy(self, case: Case) -> str | Policy:
        """Who commands the AVs of `case`: a name that `--policy` knows, unless a subclass says otherwise."""
        return case.policy

    def open(self, case: Case, warnings: tuple[str, ...]) -> Runner:
        """The runner of the case's cell, kept while cases of the same cell come."""
        from cosim.runner import Runner  # libsumo: only here, in the worker's process

        if self._runner is None or case.cell != self._cell:
            self.close()  # one simulation per process: the old one must go first
            scenario = replace(case.scenario(), warnings=warnings)
            self._runner = Runner(scenario, self.policy(case), math.radians(case.svo_deg))
            self._cell = case.cell
        return self._runner

    def close(self) -> None:
        """End the simulation."""
        runner, self._runner = self._runner, None
        if runner is not None:
            runner.close()
