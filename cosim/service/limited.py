"""Hosts of shipped scenarios: not confined, but with the resource limits of uploads."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cosim.batch.episode_runner import EpisodeRunner
from cosim.scenario.options import EpisodeOptions
from cosim.service.confined import allow_processor_time, limit_resources, timed_host
from cosim.service.settings import Limits
from cosim.workers.tasks import Progress

if TYPE_CHECKING:
    from cosim.service.watch import WatchedHost


class LimitedRunner(EpisodeRunner):
    """An `EpisodeRunner` within `limits`."""

    def __init__(self, limits: Limits) -> None:
        super().__init__()
        limit_resources(limits)
        self._processor_time = limits.cpu

    def run(
        self, case: EpisodeOptions, warnings: tuple[str, ...], outputs: str | None, progress: Progress
    ) -> dict[str, Any]:
        """One episode, as `EpisodeRunner.run`."""
        allow_processor_time(self._processor_time)
        return super().run(case, warnings, outputs, progress)


def limited_host(limits: Limits, *arguments: Any) -> WatchedHost:
    """The host of a session within `limits`; `arguments` are those of `session_host`."""
    limit_resources(limits)
    return timed_host(limits.cpu, *arguments)
