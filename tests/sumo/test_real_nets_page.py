"""The page of other authors' networks on a machine that has driven none of them."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.real_nets import KEPT, PAGE, keep, main, read

ROOT = Path(__file__).parents[2]


def test_the_page_is_what_the_rows_of_its_drives_make(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    made = tmp_path / "page.md"
    shutil.copyfile(PAGE, made)  # with what a person read in it
    main(["--held", "--out", str(made)])
    assert made.read_text() == PAGE.read_text()


def test_what_was_driven_is_counted_and_what_was_not_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    rows = read(KEPT)
    del rows["square", 200_000]
    rows["grid6", 200_000] = replace(rows["grid6", 200_000], collisions=7, av_caused=5)
    keep(tmp_path / "rows.csv", list(rows.values()))
    main(["--held", "--runs", str(tmp_path / "rows.csv"), "--out", str(tmp_path / "page.md")])
    text = (tmp_path / "page.md").read_text()
    assert "**No.**" in text
    assert "- square, seed 200000: not driven" in text
    assert "| grid6 | 1 | 220 | 60 | 7 | 5 |" in text
