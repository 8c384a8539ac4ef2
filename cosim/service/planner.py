"""Plans runs and sessions: reads the scenarios and the policies that they name."""

from __future__ import annotations

from collections.abc import Sequence

from cosim.batch import matrix
from cosim.batch.matrix import Plan
from cosim.errors import BadInput
from cosim.policies import check
from cosim.scenario import Scenario
from cosim.scenario.options import EpisodeOptions
from cosim.scenario.vet import vetted
from cosim.service.passing import told_apart
from cosim.service.settings import Limits


class Planner:
    """Hosted in a process, which is confined if it reads an upload."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits

    def plan(self, cases: Sequence[EpisodeOptions], seeds: range) -> Plan:
        """The plan of a new run. Raises BadInput, as `cosim evaluate` does."""
        found = matrix.plan(cases, seeds, check)
        matrix.check_names(found)
        for cell in found.cells:
            if cell.refused:
                raise BadInput(cell.refused, field="scenario")
            self._check_length(cell.scenario)
        return found

    def plan_again(self, cases: Sequence[EpisodeOptions], seeds: range) -> Plan:
        """The plan of a run that has begun."""
        with told_apart():
            return matrix.plan(cases, seeds, check)

    def session(self, case: EpisodeOptions) -> Scenario:
        """The scenario of a session. Raises BadInput, as `cosim run` does."""
        check(case.policy)
        scenario = vetted(case.scenario())
        self._check_length(scenario)
        return scenario

    def _check_length(self, scenario: Scenario) -> None:
        """Raises BadInput for an episode longer than `limits.simulated`."""
        most = self._limits.simulated
        if scenario.warmup + scenario.duration > most:
            problem = f"an episode and its warm-up have at most {most:g} s"
            raise BadInput(problem, field="duration", value=scenario.duration)
