"""Checks, tables and reports, in processes of their own: no request keeps the server from answering."""

from __future__ import annotations

import os
import queue
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cosim.batch import execution, matrix, spec
from cosim.batch.matrix import Plan
from cosim.batch.store import Store
from cosim.errors import BadInput, SimulationTimeout
from cosim.policies import check
from cosim.scenario import Scenario
from cosim.scenario.episode_id import EpisodeId
from cosim.scenario.vet import vetted
from cosim.service.passing import told_apart
from cosim.service.settings import Limits
from cosim.workers.worker import Worker

CLERKS = 2


class Clerk:
    """Hosted in a process whose working folder is that of the runs; the reports are imported when needed."""

    def __init__(self, runs: str, database: str | None, limits: Limits) -> None:
        os.chdir(runs)
        self._database, self._limits = database, limits

    def spec(self, flags: Mapping[str, Any]) -> Plan:
        """The plan of a request. Raises BadInput, as `cosim evaluate` does."""
        wanted = spec.read(None, flags)
        seeds = range(*wanted.seeds)
        if (cells := wanted.episodes // len(seeds)) > self._limits.cells:
            problem = f"{cells} cells are more than {self._limits.cells}: ask for several runs"
            raise BadInput(problem, field="scenario")
        found = matrix.plan([*matrix.cells(wanted)], seeds, check)
        matrix.check_names(found)
        for cell in found.cells:
            if cell.refused:
                raise BadInput(cell.refused, field="scenario")
            self._check_length(cell.scenario)
        return found

    def plan(self, cases: Sequence[EpisodeId], seeds: range) -> Plan:
        """The plan of a run that was begun."""
        with told_apart():
            return matrix.plan(cases, seeds, check)

    def session(self, flags: Mapping[str, Any]) -> tuple[Scenario, EpisodeId]:
        """What a session is opened on. Raises BadInput, as `cosim run` does."""
        (case,) = matrix.cells(spec.read(None, flags))
        check(case.policy)
        scenario = vetted(case.scenario())
        self._check_length(scenario)
        return scenario, case

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

    def recorded(self, run: str, episode: str) -> tuple[EpisodeId, Mapping[str, Any], str]:
        """An episode of a run that has its tables, by its key or seed: its case, manifest and trace hash.

        Raises BadInput.
        """
        from cosim.report.replay.episode import find

        found = find(Path(run), episode)
        return found.case, found.manifest, found.trace_hash

    def compare(self, a: str, b: str, fail_on: Sequence[str], across: Sequence[str]) -> dict[str, Any]:
        """What `cosim compare --json` prints; `a`, `b`: RUN or RUN:POLICY."""
        from cosim.report import verdict
        from cosim.report.compare import compare
        from cosim.report.pairing import side

        return verdict.document(compare(side(a), side(b), fail_on, across=across))

    def _check_length(self, scenario: Scenario) -> None:
        """Raises BadInput for an episode that would hold a process for ever."""
        most = self._limits.simulated
        if scenario.warmup + scenario.duration > most:
            problem = f"an episode and its warm-up have at most {most:g} s"
            raise BadInput(problem, field="duration", value=scenario.duration)


class Clerks:
    """`number` processes that each host a `Clerk`; `call` waits for a free one.

    Raises BadInput: what was asked for takes longer than `limits.check` s, or what the method raises.
    """

    def __init__(self, runs: Path, database: str | None, limits: Limits, number: int = CLERKS) -> None:
        self._arguments = str(runs), database, limits
        self._limit = limits.check
        self._free: queue.Queue[int] = queue.Queue()
        self._workers: list[Worker | None] = [None] * number
        for k in range(number):
            self._free.put(k)

    def call(self, method: str, *arguments: Any) -> Any:
        """One method of a `Clerk`."""
        k = self._free.get()
        try:
            worker = self._workers[k]
            if worker is None or worker.pid is None:
                worker = Worker(Clerk, *self._arguments, timeout=self._limit, name="cosim-clerk", wait=False)
                self._workers[k] = worker
            return worker.call(method, *arguments)
        except SimulationTimeout:
            raise BadInput(f"takes more than {self._limit:g} s to work out") from None
        finally:
            self._free.put(k)

    def close(self) -> None:
        """End the processes; calls that wait for them raise SimulationCrashed."""
        for worker in filter(None, self._workers):
            worker.kill()
        for _ in self._workers:
            ended = self._workers[self._free.get()]
            if ended is not None:
                ended.close()
