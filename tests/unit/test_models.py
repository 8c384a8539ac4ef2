"""What ships beside the code says where it comes from: the networks' cards and the citation."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml

import cosim
from benchmarks import model_cards
from policy.checkpoint import SHIPPED, read_card, sha256

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "models.md"


@pytest.mark.parametrize("weights", sorted(SHIPPED.glob("*.safetensors")), ids=lambda path: path.stem)
def test_a_network_that_ships_has_a_card_with_its_hash_and_a_row_with_its_limits(weights: Path) -> None:
    assert read_card(weights)["sha256"] == sha256(weights)
    page = PAGE.read_text()
    row = re.search(rf"^\| `{weights.stem}` \|(.*)\|$", page, re.MULTILINE)
    assert row is not None, "run python -m benchmarks.model_cards"
    *about, limits = (cell.strip() for cell in row[1].split(" | "))
    assert all(about)
    for limit in limits.split("; "):
        assert f"| {limit} | " in page


def test_the_cards_are_those_that_the_command_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    assert model_cards.main(["--out", str(tmp_path / "models.md")]) == 0
    assert (tmp_path / "models.md").read_text() == PAGE.read_text()


def test_the_citation_names_this_version_and_both_papers() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "type", "title", "authors", "version", "license"} <= set(citation)
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == cosim.__version__
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert citation["license"] == project["license"]
    assert {paper["url"] for paper in citation["references"]} <= set(project["urls"].values())
    first = [paper["authors"][0]["family-names"] for paper in citation["references"]]
    assert first == ["Valiente", "Toghi"]
    for paper in citation["references"]:
        assert {"type", "title", "year", "url"} <= set(paper)
        assert all({"family-names", "given-names"} <= set(author) for author in paper["authors"])
