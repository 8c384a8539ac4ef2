"""The page of what prediction is worth pairs its three arms, and says what share of the gain there is."""

from __future__ import annotations

import pytest

from benchmarks import foresight


def row(policy: str, world: str, seed: int, near: float, collisions: int = 0) -> dict[str, object]:
    return {
        **{"policy": policy, "scenario": world, "seed": seed, "status": "ok", "mission_success": True},
        **{"av_near_misses_ttc": near, "av_involved_collisions": collisions},
        **{"dt_mission_m": 300.0, "dt_av_m": 600.0, "dt_mean_m": 610.0 - near},
    }


ROWS = [
    row(arm, world, seed, near + seed % 3, collisions=int(arm == "vfn"))
    for world in ("merge", "exit")
    for seed in range(12)
    for arm, near in (("vfn", 4.0), ("vfn-p", 3.0), ("vfn-p-oracle", 2.0))
]


def test_seeds_that_an_arm_lacks_are_left_out() -> None:
    worlds = foresight.paired([*ROWS, row("vfn", "merge", 99, 0.0)])
    assert list(worlds) == ["exit", "merge", foresight.TOGETHER]
    assert [len(arms["vfn"]) for arms in worlds.values()] == [12, 12, 24]


def test_prediction_has_half_of_what_the_oracle_gains() -> None:
    worlds = foresight.paired(ROWS)
    assert foresight.gained(worlds["merge"], "dt_av_m") is None
    share = foresight.gained(worlds["merge"], foresight.NEAR)
    assert share is not None
    assert share.value == pytest.approx(0.5)
    assert share.low == pytest.approx(0.5)
    page = "\n".join(foresight.page(ROWS, ["about"]))
    assert "| merge | vfn-p less vfn | 12 | -1.00 (-1.00 to -1.00) |" in page
    assert "in near-misses of AVs that `vfn-p` has: exit 50 (50 to 50) %" in page
    (_, merge, together) = foresight.tested(worlds, "vfn-p", "vfn")
    alone = foresight.statistics.signed_rank([1.0] * 12, [0.0] * 12)
    assert float(merge[4]) == pytest.approx(2 * alone, rel=0.1)
    assert merge[5].startswith("-100.0 (")
    assert float(together[4]) < float(merge[4])
