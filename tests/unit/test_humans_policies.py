"""Who erred in front of whom, and who is in collisions beside whom."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.humans_policies import ROLES, draw_errors, headline, line, roles, who_erred
from benchmarks.worlds import WORLDS


def row(hit: bool = False, errors: list[list[Any]] | None = None, **collision: Any) -> dict[str, Any]:
    usual = {
        "collider": "hv.1",
        "victim": "av.1",
        "collider_is_av": False,
        "victim_is_av": True,
        "kind": "collision",
        "time": 20.0,
        "human_error_involved": bool(errors),
    }
    return {
        "av_involved_collisions": float(hit),
        "av_caused_collisions": 0.0,
        "crashed": hit,
        "mission_success": not hit,
        "dt_mean_m": 400.0 if hit else 500.0,
        "dt_av_m": 400.0,
        "hard_brakings_av": 1.0,
        "collision_list": json.dumps([{**usual, **collision}] if hit else []),
        "human_error_list": json.dumps(errors or []),
    }


@pytest.mark.parametrize(
    ("errors", "found"),
    [
        ([["inattention", "hv.1", 18.0]], ("collider", "inattention")),
        ([["cut_in", "hv.1", 4.0], ["inattention", "hv.1", 18.0]], ("collider", "inattention")),
        ([["hard_braking", "av.1", 19.0]], ("victim", "hard_braking")),
        ([["hard_braking", "hv.9", 19.0]], ("ahead", "")),
        ([["inattention", "hv.1", 4.0]], ("ahead", "")),  # over long ago: somebody else erred
        ([["stalled_car", "hv.1", -60.0]], ("collider", "stalled_car")),
        ([["inattention", "hv.1", 21.0]], ("ahead", "")),  # only afterwards
        ([], ("nobody", "")),
    ],
)
def test_the_last_error_of_one_of_both_is_told(errors: list[list[Any]], found: tuple[str, str]) -> None:
    assert who_erred(row(True, errors)) == found


def test_a_collision_without_an_av_does_not_count_as_its_first() -> None:
    mixed = row(True, [["inattention", "hv.1", 18.0]])
    others = {"collider_is_av": False, "victim_is_av": False, "kind": "collision", "time": 5.0}
    mixed["collision_list"] = json.dumps([others, *json.loads(mixed["collision_list"])])
    assert who_erred(mixed) == ("collider", "inattention")


def test_roles_and_kinds_are_counted_over_collisions_of_avs() -> None:
    rows = [row(), row(True, [["inattention", "hv.1", 18.0]]), row(True, [["hard_braking", "hv.9", 19.0]])]
    assert roles("idm", rows) == ["idm", "2", "1", "0", "1", "0", "1 inattention"]
    assert len(ROLES) == 4


def test_a_line_counts_worlds_apart_and_pairs_by_world_and_seed() -> None:
    idm = {(WORLDS[0], seed): row(seed < 6) for seed in range(8)}
    mine = {(WORLDS[0], seed): row(seed < 1) for seed in range(8)}
    cells = line("vfn-p", mine, idm)
    assert cells[1] == "1 of 8"
    assert cells[2] == "0 of 0"
    assert cells[1 + len(WORLDS)].startswith("12.5 (")
    assert cells[2 + len(WORLDS)].startswith("-62.5 (")
    assert float(cells[3 + len(WORLDS)]) == pytest.approx(2 * 0.5**5, rel=0.02)  # five pairs, all one way
    assert line("idm", idm, idm)[2 + len(WORLDS) : 4 + len(WORLDS)] == ["", ""]


def test_altruists_stand_beside_egoists_on_equal_seeds() -> None:
    found = {
        "kind": {("contested", "merge", seed): row() for seed in range(8)},
        "selfish": {("contested", "merge", seed): row(seed < 6) for seed in range(9)},
    }
    cells = headline("kind", "selfish", "merge", found)
    assert cells[:4] == ["merge", "kind", "selfish", "8"]
    assert cells[4].startswith("0, 6: -75 (")
    assert cells[5].startswith("8, 2: 75 (")
    assert cells[6].startswith("75 (")


def test_a_picture_tells_who_erred(tmp_path: Path) -> None:
    erred = row(True, [["inattention", "hv.1", 18.0]])
    found = {"idm": {("dense", "merge", 1): erred, ("dense", "merge", 2): row()}, "vfn": {}}
    shown = draw_errors(found, tmp_path / "errors.png")
    assert shown == "![who erred in front of whom](errors.png)"
    assert (tmp_path / "errors.png").stat().st_size > 5000
