"""The prioritizer's settings as they are driven: the store holds each episode once, the page comes of it."""

from __future__ import annotations

from pathlib import Path

from benchmarks import prioritizer
from benchmarks.papers.driving import Settings, drive
from cosim.seeding import TUNING_SEEDS


def test_settings_are_driven_once_on_tuning_seeds_and_shown(tmp_path: Path) -> None:
    settings = Settings(
        runs=tmp_path / "runs",
        out=tmp_path / "out",
        scale=1e-6,
        workers=1,
        duration=2.0,
        first=TUNING_SEEDS.start,
    )
    wanted = ("cruise", "cruise, no mask")
    orders = [o for o in prioritizer.orders() if o.scenario == "merge" and o.agent.name in wanted]
    results = drive(orders, settings, "small")
    assert [one.order.name for one in results.driven] == [*wanted]
    for one in results.driven:
        assert [row["seed"] for row in one.rows] == [100_000, 100_001]
        assert {row["status"] for row in one.rows} == {"ok"}
        assert {row["policy_label"] for row in one.rows} == {""}, "nothing in it is to be trained"
    guarded, bare = ([row["veto_rate"] for row in one.rows] for one in results.driven)
    assert all(rate is not None for rate in guarded)
    assert bare == [0.0, 0.0]
    prioritizer.write(results, settings)
    page = (settings.out / "prioritizer.md").read_text()
    assert "equal seeds from 100,000 on" in page
    assert "### cruise, merge" in page
    assert (settings.out / "prioritizer-cruise.png").is_file()
    again = drive(orders, settings, "small")
    assert [one.rows for one in again.driven] == [one.rows for one in results.driven], "timings and all"
