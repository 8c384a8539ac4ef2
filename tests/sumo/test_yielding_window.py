"""Windows of yielding: a copy that never yields is what happens, one that yields differs; the page counts."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import yielding_window
from benchmarks.yielding import HABITS
from benchmarks.yielding_window import NEVER, Branch, Exchanged, Windows, drive, page
from cosim.episode import Episode, Step
from policy.agents import yield_rule
from policy.inputs.needs import Need, Needs
from sumo_scenarios.draw import write
from sumo_scenarios.full_roads import FullRoad

ROAD = 100_243  # a full minor road


def test_a_copy_that_never_yields_is_what_happens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(yielding_window, "TIMES", (100.0,))
    monkeypatch.setattr(yielding_window, "AFTER", (40, 50, 60))
    monkeypatch.setattr(Exchanged, "on", False)
    for constant in HABITS.values():
        monkeypatch.setattr(yield_rule, constant, False)  # `drive` changes it; restored after this test
    happened: list[float] = []

    class Watched(Windows):
        def __init__(self, *about: Any) -> None:
            super().__init__(*about)
            self._times = [*yielding_window.TIMES]

        def on_step(self, episode: Episode, step: Step) -> None:
            super().on_step(episode, step)
            if self.rows and episode.elapsed in (140.0, 150.0, 160.0):
                figures = episode.result("").metrics
                total = (figures["vehicles_due"].value or 0.0) * (figures["total_delay_s"].value or 0.0)
                happened.append(round(total, 1))

    monkeypatch.setattr(yielding_window, "Windows", Watched)
    never, lines = drive(FullRoad(ROAD, "minor", write(ROAD, tmp_path)), (NEVER, "yields at lines"))
    assert [never.after_100_s, never.after_200_s, never.after_400_s] == happened
    assert never.yieldings == 0 < lines.yieldings
    assert lines.after_400_s != never.after_400_s


def test_the_page_leaves_out_windows_without_a_yielding() -> None:
    rows = [
        Branch("weave", seed, time, branch, served, 100.0, 200.0, 400.0 - served)
        for seed in (1, 2, 3)
        for time, served in ((100.0, 10), (200.0, 0))
        for branch, served in ((NEVER, 0), ("eases off for signals", served), ("yields at lines", 0))
    ]
    text = "\n".join(page(rows))
    assert "| eases off for signals | `weave` | 3 | 10 | 0 (0 to 0) | 0 (0 to 0) | -10 (-10 to -10) |" in text
    assert "yields at lines | `weave`" not in text
    assert "3 weave" in text


def test_each_av_gets_the_needs_of_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    needs: dict[str, list[Need]] = {av: [Need(f"before {av}", False, 9.0, 0, 5.0, 90.0, 0.0)] for av in "abc"}
    monkeypatch.setattr(Needs, "find", lambda *_: needs)
    exchanged = Exchanged.__new__(Exchanged)
    histories: Any = {av: SimpleNamespace() for av in "abcd"}
    assert exchanged.find(histories) is needs
    monkeypatch.setattr(Exchanged, "on", True)
    found = exchanged.find(histories)
    assert sorted(found) == ["a", "b", "c", "d"]
    assert all(need.vehicle != f"before {av}" for av, of in found.items() for need in of)
    assert sum(map(len, found.values())) == 3
