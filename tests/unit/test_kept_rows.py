"""The episodes kept behind the pages of `vfn-p`: whole, drivable by name, the same file for the same rows."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from run_rows import cell, write

from benchmarks import rows
from cosim.errors import BadInput
from policy.agents import POLICIES

ROOT = Path(__file__).parents[2]
PAGES = {
    "foresight": 240,
    "forced_entry": 200,
    "humans": 2000,
    "learned": 80,
}  # episodes an arm


@pytest.mark.parametrize("page", PAGES)
def test_what_is_kept_of_a_page_can_be_driven_anew(page: str, tmp_path: Path) -> None:
    known = rows.read(page, ROOT / rows.KEPT)
    assert {row["policy"] for row in known} <= POLICIES.keys()
    assert all(len(row["trace_hash"]) == 64 for row in known)
    identities = Counter(tuple(row[name] for name in rows.IDENTITY) for row in known)
    assert max(identities.values()) == 1
    arms = Counter((row["policy"], row["errors"], row["svo_deg"]) for row in known)
    assert max(arms.values()) == PAGES[page]
    asked = rows.words(known[0], tmp_path)
    assert asked[:2] == ["--scenario", known[0]["scenario"]]
    assert f"{known[0]['seed']}:{int(known[0]['seed']) + 1}" in asked


def test_a_row_says_what_the_command_line_is_to_say(tmp_path: Path) -> None:
    row = dict.fromkeys(rows.COLUMNS, "") | {"scenario": "merge", "demand": "contested", "preset": "lawful"}
    row |= {"behavior": "mixed", "policy": "vfn", "errors": "forced_0.5-64deca90", "seed": "200007"}
    row |= {"svo_deg": "60.0"}
    assert rows.words(row, tmp_path) == [
        *("--scenario", "merge", "--demand", "contested", "--preset", "lawful"),
        *("--policy", "vfn", "--svo", "60.0", "--seeds", "200007:200008"),
        *("--behavior", "mixed", "--errors", str(tmp_path / "forced_0.5.yaml")),
    ]
    assert (tmp_path / "forced_0.5.yaml").is_file()
    with pytest.raises(BadInput, match="no rows are kept"):
        rows.read("nothing", tmp_path)


def test_rows_are_added_to_those_that_are_there_and_newer_ones_replace_them(tmp_path: Path) -> None:
    first = write(tmp_path / "first", cell("idm", 3))
    second = write(tmp_path / "second", cell("idm", 2, first=200_002, columns={"dt_mean_m": [700.0, 701.0]}))
    with pytest.raises(BadInput, match="no rows are kept"):
        rows.keep("page", [second], tmp_path, add=True)
    assert rows.keep("page", [first], tmp_path) == 3
    assert rows.keep("page", [second], tmp_path, add=True) == 4
    found = {int(row["seed"]): row["dt_mean_m"] for row in rows.read("page", tmp_path)}
    assert found == {200_000: "810.0", 200_001: "810.0", 200_002: "700.0", 200_003: "701.0"}
