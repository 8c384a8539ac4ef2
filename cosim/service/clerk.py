"""Plans, tables and reports in separate processes, so that no request blocks the server."""

from __future__ import annotations

import os
import queue
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from cosim.batch import execution, matrix, spec
from cosim.batch.matrix import Plan
from cosim.batch.store import Store
from cosim.errors import BadInput, SimulationCrashed, SimulationTimeout
from cosim.scenario import Scenario
from cosim.scenario.options import EpisodeOptions
from cosim.service.confined import confined_planner, room
from cosim.service.passing import told_apart
from cosim.service.planner import Planner
from cosim.service.processes import Processes
from cosim.service.settings import Limits, Settings
from cosim.workers.worker import Worker

CLERKS = 2


class Clerk(Planner):
    """Hosted in an unconfined process, which reads no uploads; the working folder is the folder of runs.

    The code of reports is imported when needed.
    """

    def __init__(self, runs: str, database: str | None, limits: Limits) -> None:
        super().__init__(limits)
        os.chdir(runs)
        self._database = database

    def asked(self, flags: Mapping[str, Any]) -> tuple[list[EpisodeOptions], range]:
        """The case of every cell of a request, and its seeds; reads no file. Raises BadInput."""
        wanted = spec.read(None, flags)
        seeds = range(*wanted.seeds)
        if (cells := wanted.episodes // len(seeds)) > self._limits.cells:
            problem = f"{cells} cells are more than {self._limits.cells}: ask for several runs"
            raise BadInput(problem, field="scenario")
        return [*matrix.cells(wanted)], seeds

    def finish(self, run: str, plan: Plan) -> None:
        """Write the tables, the manifest and the summary of a run."""
        from cosim.report import run_folder

        folder = Path.cwd() / run
        with told_apart(), Store.in_folder(folder, self._database) as store:
            run_folder.export(folder, store.rows(), execution.manifest(plan, store), plan.episodes)

    def report(self, run: str) -> None:
        """Write the report of a run that has its tables."""
        from cosim.report import html, run_folder  # matplotlib: a second

        html.write(run_folder.read(run), None, shown=run)

    def recorded(self, run: str, episode: str) -> tuple[EpisodeOptions, Mapping[str, Any], str]:
        """An episode of a run that has its tables, by its key or seed: its case, manifest and trace hash.

        Raises BadInput.
        """
        from cosim.report.replay.episode import find

        found = find(Path(run), episode)
        return found.case, found.manifest, found.trace_hash

    def compare(self, a: str, b: str, fail_on: Sequence[str], across: Sequence[str]) -> dict[str, Any]:
        """The document of `cosim compare --json`; `a`, `b`: RUN or RUN:POLICY."""
        from cosim.report import verdict
        from cosim.report.compare import compare
        from cosim.report.pairing import side

        return verdict.document(compare(side(a), side(b), fail_on, across=across))


class Clerks:
    """Processes that each host a `Clerk`; callers wait for a free one.

    Uploads are read by a new confined process instead of a clerk.

    Raises BadInput: the call takes longer than `limits.check` s, or the method raises it.
    """

    def __init__(self, settings: Settings, processes: Processes) -> None:
        self._settings, self._processes = settings, processes
        self._arguments = str(settings.runs), settings.database, settings.limits
        self._limit = settings.limits.check
        self._free: queue.Queue[int] = queue.Queue()
        self._workers: list[Worker | None] = [None] * CLERKS
        for k in range(CLERKS):
            self._free.put(k)

    def plan(self, flags: Mapping[str, Any], uploads: Sequence[str]) -> Plan:
        """The plan of a new run from the request's flags and its uploads."""
        cases, seeds = self.call("asked", flags)
        return self._planned("plan", cases, seeds, uploads)

    def plan_again(self, cases: Sequence[EpisodeOptions], seeds: range, uploads: Sequence[str]) -> Plan:
        """The plan of a run that was begun."""
        return self._planned("plan_again", cases, seeds, uploads)

    def session(self, flags: Mapping[str, Any], uploads: Sequence[str]) -> tuple[Scenario, EpisodeOptions]:
        """The scenario of a session."""
        (case,), _ = self.call("asked", flags)
        scenario: Scenario = self._read(uploads, "session", case)
        return scenario, case

    def call(self, method: str, *arguments: Any) -> Any:
        """Call one method of a `Clerk`, without uploads."""
        k = self._free.get()
        try:
            worker = self._workers[k]
            if worker is None or worker.pid is None:
                worker = Worker(Clerk, *self._arguments, timeout=self._limit, name="cosim-clerk", wait=False)
                self._workers[k] = worker
            return worker.call(method, *arguments)
        except SimulationTimeout:
            raise self._late() from None
        finally:
            self._free.put(k)

    def close(self) -> None:
        """End the processes; calls in progress raise SimulationCrashed."""
        for worker in filter(None, self._workers):
            worker.kill()
        for _ in self._workers:
            ended = self._workers[self._free.get()]
            if ended is not None:
                ended.close()

    # ---- inside ----

    def _planned(
        self, method: str, cases: Sequence[EpisodeOptions], seeds: range, uploads: Sequence[str]
    ) -> Plan:
        """A plan checked against the requested cases: the confined process is not trusted."""
        found: Plan = self._read(uploads, method, cases, seeds)
        cells = zip(found.cells, cases, strict=True)
        return Plan(tuple(replace(cell, case=case) for cell, case in cells), seeds)

    def _read(self, uploads: Sequence[str], method: str, *arguments: Any) -> Any:
        """Call one method of a `Planner`, in a confined process if there are uploads."""
        if not uploads:
            return self.call(method, *arguments)
        k = self._free.get()  # at most one call per clerk
        try:
            with room(self._settings, uploads) as confined:
                planner = confined_planner, confined
                return self._processes.ask("cosim-planner", self._limit, planner, method, *arguments)
        except SimulationTimeout:
            raise self._late() from None
        except SimulationCrashed as error:
            raise BadInput(f"ends the process that reads it: {error}", field="scenario") from None
        finally:
            self._free.put(k)

    def _late(self) -> BadInput:
        return BadInput(f"takes more than {self._limit:g} s to check")
