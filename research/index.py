"""The index of results, and whether every page is of the weights and definitions that are here."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from cosim.files import whole
from research.drive import Work
from research.schema import Claim

NOT_DRIVEN = "Not driven yet."
INDEX = """\
# What the papers claimed, and what we found

P: Valiente et al., prediction-aware cooperative driving. T: Toghi et al., altruistic maneuver planning.
Both simulate with HighwayEnv, we with SUMO; scenarios and demands are ours. Every line is written by
`python -m research page` from `research/claims/`. A claim that is not driven yet has no verdict: a page of
its name, where there is one, shows earlier networks.

| claim | source | verdict | page |
|---|---|---|---|
"""


def write(claims: Sequence[Claim], out: Path) -> Path:
    """README.md of the results: a line for every claim, then every page."""
    text = INDEX
    for claim in claims:
        page = out / f"{claim.name}.md"
        there = f"[{claim.name}]({page.name})" if page.is_file() else ""
        text += f"| {claim.sentence} | {claim.source} | {answer(claim, out)} | {there} |\n"
    pages = [*out.glob("*.md"), *out.glob("uses*/*.md")]
    others = sorted(str(p.relative_to(out)) for p in pages if p.name != "README.md")
    text += "\nAll pages: " + ", ".join(f"[{name.removesuffix('.md')}]({name})" for name in others) + ".\n"
    with whole(out / "README.md") as draft:
        draft.write_text(text, encoding="utf-8")
    return out / "README.md"


def answer(claim: Claim, out: Path) -> str:
    """Verdict and effects, from the first paragraph of the claim's page."""
    page = out / f"{claim.name}.md"
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    paragraphs = [" ".join(part.split()) for part in text.split("\n\n")]
    found = re.match(r"\*\*([\w ]+\.)\*\* .*?: (less .*)\. By condition:", "".join(paragraphs[1:2]))
    return f"**{found[1]}** {found[2]}" if found else NOT_DRIVEN


def stale(claim: Claim, work: Work, out: Path) -> Iterator[str]:
    """Why the claim's page is not of the weights and definitions that are here, a line each.

    A page that this engine has not written yet is none of its business.
    """
    page, table = out / f"{claim.name}.md", out / "data" / f"{claim.name}.csv"
    if answer(claim, out) == NOT_DRIVEN:
        return
    if f"({claim.digest})" not in page.read_text(encoding="utf-8"):
        yield f"{page}: made of another definition of the claim"
    with table.open(newline="", encoding="utf-8") as file:
        made = {
            (r["scenario"], r["condition"], r["arm"]): r for r in csv.DictReader(file) if not r["against"]
        }
    for (condition, name), arm in work.arms[claim.name].items():
        row = made.get((condition.scenario, condition.text, name))
        if row is None:
            yield f"{table}: {name} in {condition.scenario} is not there"
        elif row["weights"] != arm.weights:
            yield f"{table}: {name} was driven by weights {row['weights']}, here are {arm.weights}"
        elif row["definitions"] != arm.definitions:
            yield f"{table}: {name} in {condition.scenario} was driven with other files or settings"
