"""The page of real nets on a machine that has driven none of them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.real_nets import KEPT, main

ROOT = Path(__file__).parents[2]
PAGE = Path("docs/results/real_nets.md")


def test_the_page_is_what_the_rows_of_its_drives_make(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    main(["--held", "--out", str(tmp_path / "page.md")])
    assert (tmp_path / "page.md").read_text() == PAGE.read_text()


def test_a_row_changed_by_hand_is_seen_on_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    for row in KEPT.glob("*.json"):
        (tmp_path / row.name).write_text(row.read_text())
    changed = json.loads((tmp_path / "grid6-idm-200000.json").read_text())
    changed["collision_list"] = changed["collision_list"] * 7
    (tmp_path / "grid6-idm-200000.json").write_text(json.dumps(changed))
    main(["--held", "--runs", str(tmp_path), "--out", str(tmp_path / "page.md")])
    text = (tmp_path / "page.md").read_text()
    assert "7 of this sort (HV into AV, overlap) in all: `:gneJ17_4_0` 7" in text
    assert text.count("grid6, idm, seed 200000: 188.4 s") == 5
