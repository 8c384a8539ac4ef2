"""The hosted object of a batch's worker processes: consecutive episodes in one process."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from cosim.host import Host, Hosts
from cosim.scenario.options import EpisodeOptions
from cosim.types import Policy
from cosim.workers.tasks import Progress


class EpisodeRunner(Hosts):
    """Keeps the host of the last episode's cell."""

    def run(
        self, case: EpisodeOptions, warnings: tuple[str, ...], outputs: str | None, progress: Progress
    ) -> dict[str, Any]:
        """One episode; the document of `cosim run --json`.

        `warnings` are those of vetting; SUMO's own outputs go to the folder `outputs`/key.
        """
        folder = None if outputs is None else Path(outputs) / case.key
        host = self.open(case, warnings)
        return host.run(case.seed, progress, outputs=case.outputs, folder=folder).document()

    def policy(self, case: EpisodeOptions) -> str | Policy:
        """The policy of `case`: a name for `--policy`, unless a subclass overrides it."""
        return case.policy

    def open(self, case: EpisodeOptions, warnings: tuple[str, ...]) -> Host:
        """The host of the case's cell."""

        def build() -> Host:
            scenario = replace(case.scenario(), warnings=warnings)
            policy, svo = self.policy(case), math.radians(case.svo_deg)
            return Host(scenario, policy, svo, metrics=case.metrics, reward=case.reward)

        return self.host(case.cell, build)
