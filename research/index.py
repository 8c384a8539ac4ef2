"""The index of results, and the check that every page has the present weights and definitions."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from cosim.files import whole
from research.drive import Arms, Work, pooled
from research.schema import Claim

NOT_DRIVEN = "Not driven yet."
SAMPLES = {"t_figures": ("t_figure8",)}  # claim -> pages that show sample episodes of it
Key = tuple[str, str, str]  # scenario, condition and arm, as the CSV has them
INDEX = """\
# What the papers claimed, and what we found

P: Valiente et al., prediction-aware cooperative driving. T: Toghi et al., altruistic maneuver planning.
Both simulate with HighwayEnv, we with SUMO; scenarios and demands are ours. Lines are written by
`python -m research page`. A verdict comes with its counts over conditions and with paired differences to
the arms that are named.

| claim | source | must hold | verdict | page |
|---|---|---|---|---|
"""


def write(claims: Sequence[Claim], out: Path) -> Path:
    """README.md of the results: a line for every claim, then the other pages."""
    text = INDEX
    for claim in claims:
        page = out / f"{claim.name}.md"
        there = f"[{claim.name}]({page.name})" if page.is_file() else ""
        text += f"| {claim.sentence} | {claim.source} | {claim.holds} | {answer(claim, out)} | {there} |\n"
    shown = {"README.md", *(f"{claim.name}.md" for claim in claims)}
    others = sorted(p.name for p in out.glob("*.md") if p.name not in shown)
    text += "\nOther pages: " + ", ".join(f"[{name.removesuffix('.md')}]({name})" for name in others) + ".\n"
    with whole(out / "README.md") as draft:
        draft.write_text(text, encoding="utf-8")
    return out / "README.md"


def answer(claim: Claim, out: Path) -> str:
    """Verdict, verdicts by condition, and effects, from the first paragraph of the claim's page."""
    page = out / f"{claim.name}.md"
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    paragraphs = [" ".join(part.split()) for part in text.split("\n\n")]
    pattern = r"\*\*([\w, ]+\.)\*\* .*?: (difference to .*)\. By condition: (.*)\."
    found = re.match(pattern, "".join(paragraphs[1:2]))
    if found is None:
        return NOT_DRIVEN
    effects = re.sub(r"difference to (`[^`]+`) (.*?), (\d+ pairs)", r"\2 against \1, \3", found[2])
    return f"**{found[1]}** {found[3]}; {effects}"


def stale(claim: Claim, work: Work, out: Path) -> Iterator[str]:
    """Differences of the claim's pages from the present weights and definitions, a line each.

    Pages not written by this engine are skipped.
    """
    page, arms = out / f"{claim.name}.md", pooled(claim, work.arms[claim.name])
    if answer(claim, out) != NOT_DRIVEN:
        if f"({claim.digest})" not in page.read_text(encoding="utf-8"):
            yield f"{page}: made from another definition of the claim"
        made = _made(out, claim.name)
        for condition, arm in arms:
            if (condition.scenario, condition.text, arm) not in made:
                yield f"{page}: {arm} in {condition.scenario} is missing"
    for name in (claim.name, *SAMPLES.get(claim.name, ())):
        yield from _differing(out / f"{name}.md", _made(out, name), arms)


def _differing(page: Path, made: Mapping[Key, Mapping[str, str]], arms: Arms) -> Iterator[str]:
    """Arms with other weights or definitions than on the page."""
    for (condition, name), arm in arms.items():
        row = made.get((condition.scenario, condition.text, name))
        if row is None:
            continue
        if row["weights"] != arm.weights:
            yield f"{page}: {name} was driven with weights {row['weights']}, now they are {arm.weights}"
        elif row["definitions"] != arm.definitions:
            yield f"{page}: {name} in {condition.scenario} was driven with other files or settings"


def _made(out: Path, name: str) -> dict[Key, dict[str, str]]:
    """A row of the page's CSV for every arm and condition; empty if not written by this engine."""
    table = out / "data" / f"{name}.csv"
    if not table.is_file():
        return {}
    with table.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if "definitions" in row and not row["against"]]
    return {(row["scenario"], row["condition"], row["arm"]): row for row in rows}
