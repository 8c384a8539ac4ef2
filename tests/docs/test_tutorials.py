"""Every tutorial works: its files are written and its commands run, in their order, in an empty folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.docs.pages import ROOT, blocks, shell

TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
# What a tutorial says that its reader sees.
SEEN = {
    "first_drive": (
        "mission.0 is the mission vehicle: the human driver that has to merge.",
        "With altruist-rule it merged after",
        "With idm it did not merge within",
        "interventions",
        "trace hash altruist-rule",
    ),
    "gate": ("exit code 1", "collision_rate"),
    "own_network": ("time-to-teleport 300 -> -1", "traffic as-is", "arrivals", "total_delay_hv_s"),
    "own_policy": ("merge / contested / careful", "interventions", "preset unguarded"),
    "train_agent": ("idm -> Ppo", "TensorDict", "B - A"),
}


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_a_tutorial_works_line_by_line(page: Path, tmp_path: Path) -> None:
    printed = ""
    for block in blocks(page):
        if block.file:
            (tmp_path / block.file).write_text(block.text, encoding="utf-8")
        elif block.language == "sh":
            printed += shell(block.text, tmp_path)
    assert [words for words in SEEN[page.stem] if words not in printed] == [], printed
