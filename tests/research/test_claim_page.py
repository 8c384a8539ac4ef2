"""A page says yes, no or unresolved first, and shows what it rests on."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from research import index, page
from research.drive import Settings
from research.evaluate import Found, evaluate
from tests.research.claims import SMALL, arms, claim, rows

SAVES = (rows([], 400), rows(range(100), 400, errors="stress"))


@pytest.fixture
def found(tmp_path: Path) -> Found:
    of = {
        (s, name): mine for s in ("merge", "exit") for name, mine in zip(("rule", "idm"), SAVES, strict=True)
    }
    of |= {(scenario, "lane"): rows([1], 40) for scenario in ("merge", "exit")}
    small = claim(tmp_path, published={"merge": {"rule": 1.5}}, note="A note.")
    return evaluate(small, arms(of), {"units": {"dt_mean_m": "m"}})


def test_the_verdict_stands_first_with_effect_interval_and_pairs(found: Found) -> None:
    lines = page.lines(found, Settings())
    assert lines[0] == f"# {SMALL['sentence']}"
    text = " ".join(lines[2:5])
    assert text.startswith(
        "**Yes.** Source: ours. `collision_rate` of `rule`: difference to `idm` -25.0 pp (-28.1 to -22.1)"
    )
    assert "By condition: 2 yes." in text


def test_the_table_has_a_row_for_every_arm_and_difference(found: Found) -> None:
    rows, same = page.table(found)
    assert rows[0] == "| collision_rate, % | n | errors | weights | merge | exit |"
    assert rows[2].startswith("| rule | 400 | none | 0123456789ab | 0.00 (0.00 to 0.95) [1.5]")
    assert rows[3].startswith("| idm | 400 | stress | - | 25.0 (21.0 to 29.5)")
    assert rows[4].startswith("| lane | 40 |")
    assert rows[5].endswith("p < 0.001: yes |")
    assert rows[6].startswith("| dt_mean_m, m | 400 |")
    assert same == "In all rows: preset unguarded, sensing ideal, drivers mixed."


def test_it_says_conditions_tests_power_and_the_command(found: Found) -> None:
    text = " ".join(page.lines(found, replace(Settings(), scale=0.5, duration=2.0)))
    assert "A note." in text
    assert "Brackets and crosses are the paper's figures." in text
    assert "**Episodes are cut to 2 s.**" in text
    assert "Smallest effect of interest: 10 pp, everywhere" in text
    assert "Power: 99 % (400 pairs)." in text
    assert "`python -m research page small --scale 0.5 --duration 2` (" in text


@pytest.mark.parametrize("front", [(), ("dt_mean_m", "collision_rate")])
def test_the_same_figures_give_the_same_files(found: Found, front: tuple[str, ...], tmp_path: Path) -> None:
    found = replace(found, claim=replace(found.claim, front=front))
    page.write(found, Settings(), tmp_path / "a")
    page.write(found, Settings(), tmp_path / "b")
    for name in ("small.md", "small.svg", "data/small.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert (tmp_path / "a" / "small.svg").stat().st_size > 1000


def test_the_csv_has_every_line_and_leaves_na_empty(found: Found, tmp_path: Path) -> None:
    page.write(found, Settings(), tmp_path)
    with (tmp_path / "data" / "small.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 2 * 3 * 2 + 2 * 2
    assert [line["p_holm"] == "" for line in lines] == [True] * 12 + [False, True] * 2


def test_the_index_has_a_line_for_every_claim_and_says_what_is_not_driven(
    found: Found, tmp_path: Path
) -> None:
    other = replace(found.claim, name="other", sentence="Nobody drove this")
    page.write(found, Settings(), tmp_path)
    (tmp_path / "law.md").touch()
    text = index.write([found.claim, other], tmp_path).read_text()
    assert (
        f"| {SMALL['sentence']} | ours | everywhere | **Yes.** 2 yes; "
        "-25.0 pp (-28.1 to -22.1) against `idm`, 800 pairs | [small](small.md) |" in text
    )
    assert "| Nobody drove this | ours | everywhere | Not driven yet. |  |" in text
    assert "Other pages: [law](law.md)." in text


def test_a_page_of_other_weights_files_or_definition_is_found(found: Found, tmp_path: Path) -> None:
    page.write(found, Settings(), tmp_path)

    def stale(changed: Any = found.claim, **arm: str) -> list[str]:
        here = {key: replace(one, **(arm if key[1] == "rule" else {})) for key, one in found.arms.items()}
        return [*index.stale(changed, SimpleNamespace(arms={"small": here}), tmp_path)]  # type: ignore[arg-type]

    assert stale() == []
    assert [line.split(": ", 1)[1] for line in stale(weights="fedcba987654")] == [
        "rule was driven with weights 0123456789ab, now they are fedcba987654"
    ] * 2
    assert "rule in exit was driven with other files or settings" in stale(definitions="others")[1]
    assert stale(replace(found.claim, holds="somewhere")) == [
        f"{tmp_path / 'small.md'}: made from another definition of the claim"
    ]
    (tmp_path / "small.md").write_text("# By another program\n")
    (tmp_path / "data" / "small.csv").write_text("scenario,arm,against,figure\nmerge,rule,,collision_rate\n")
    assert stale(weights="fedcba987654") == []


def test_a_page_of_sample_episodes_is_held_to_the_claim_they_are_of(found: Found, tmp_path: Path) -> None:
    claim = replace(found.claim, name="t_figures")
    page.write_csv(tmp_path / "data" / "t_figure8.csv", [*found.lines()][:1])
    assert [*index.stale(claim, SimpleNamespace(arms={"t_figures": found.arms}), tmp_path)] == []  # type: ignore[arg-type]
    other = {key: replace(arm, definitions="others") for key, arm in found.arms.items()}
    (line,) = index.stale(claim, SimpleNamespace(arms={"t_figures": other}), tmp_path)  # type: ignore[arg-type]
    assert line.endswith("t_figure8.md: rule in merge was driven with other files or settings")
