"""Looking ahead in SUMO: what would come is what comes, and looking changes nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cosim.cli.main import main
from cosim.host import Host
from cosim.scenario import load
from cosim.scenario.human_errors import levels
from cosim.types import (
    Decision,
    History,
    LookAhead,
    MetaAction,
    ObservationConfig,
    PolicyContext,
    Preset,
    Snapshot,
)
from cosim.workers.worker import Worker

EVERY, FRAMES = 4, 4  # decisions between two looks, frames that are looked ahead: two decisions


class Keeps:
    """Its AVs keep what they do; now and then it looks ahead."""

    name, label = "keeps", ""
    observation = ObservationConfig(maps=False)
    av_parameters: Mapping[str, str] = {}

    def __init__(self, looks: bool) -> None:
        self._looks = looks

    def looks_ahead(self, look: LookAhead) -> None:
        self._look = look

    def reset(self, context: PolicyContext) -> None:
        self.step = 0
        self.seen: list[tuple[int, tuple[Snapshot, ...]]] = []

    def decide(self, histories: Mapping[str, History]) -> dict[str, Decision]:
        if self._looks and self.step % EVERY == 0:
            self.seen.append((self.step, tuple(self._look(FRAMES))))
        self.step += 1
        return {av: Decision(MetaAction.IDLE) for av in histories}


class Looking:
    """In a worker: drives one episode with and without looking."""

    def drive(self, errors: str | None) -> tuple[list[str], float, int]:
        """Trace hashes; the largest distance (m) between what was foreseen and what came; looks."""
        level = None if errors is None else levels()[errors]
        scenario = replace(
            load("merge", demand=["contested"], preset=Preset.UNGUARDED), errors=level, duration=12.0
        )
        host = Host(scenario, Keeps(True), 0.0)
        hashes: list[str] = []
        worst, looks = 0.0, 0
        for policy in (host.policy, Keeps(False)):
            episode, came = host.episode, []
            policy.reset(episode.context(150_000, 0.0))
            episode.start(150_000)
            while not episode.over:
                episode.advance(policy.decide(episode.histories))
                came += episode.frames
            hashes.append(episode.trace_hash())
            if policy is host.policy:
                for step, foreseen in policy.seen:  # type: ignore[attr-defined]
                    looks += 1
                    for frame, real in zip(foreseen, came[2 * step :], strict=False):
                        if errors is None:
                            assert frame.ids == real.ids
                            worst = max(worst, float(np.hypot(frame.x - real.x, frame.y - real.y).max()))
        host.close()
        return hashes, worst, looks


@pytest.mark.parametrize("errors", [None, "stress"])
def test_looking_ahead_tells_what_comes_and_changes_nothing(errors: str | None) -> None:
    with Worker(Looking) as worker:
        hashes, worst, looks = worker.call("drive", errors)
    assert hashes[0] == hashes[1]
    assert looks >= 7
    assert worst < 0.2, "m, of some 15 driven: only AVs that get their first command meanwhile differ"


def test_the_oracle_drives_by_what_comes(capsys: pytest.CaptureFixture[str]) -> None:
    found: dict[str, Any] = {}
    for policy in ("vfn-p", "vfn-p-oracle"):
        words = ["run", "merge", "--demand", "contested", "--policy", policy, "--duration", "4", "--json"]
        assert main(words) == 0
        found[policy] = capsys.readouterr().out
    assert '"policy": "vfn-p-oracle"' in found["vfn-p-oracle"]
    assert '"steps": 10' in found["vfn-p-oracle"]


def test_nobody_looks_ahead_where_sumo_writes_its_outputs(
    tmp_path: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", "merge", "--policy", "vfn-p-oracle", "--duration", "2", "--output", "fcd"]
    assert main([*words, "--out", str(tmp_path / "run")]) == 2
    assert "rollouts are impossible" in capsys.readouterr().err
