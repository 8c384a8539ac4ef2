"""Markdown pages of benchmarks: a table's row, a page, and a part of a page between marks."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from cosim.files import whole

READ = "read"  # between these marks stands what a person read in the figures


def marks(name: str) -> tuple[str, str]:
    """What stands before and behind a part of a page that is kept, or made anew, by itself."""
    return f"<!-- {name} -->", f"<!-- end of {name} -->"


def marked(text: str, name: str) -> tuple[str, str, str] | None:
    """What stands before the marks of this name, between and behind them; None where they are not there.

    Raises SystemExit where only the first is: what a person wrote behind it is not to be lost.
    """
    begin, end = marks(name)
    before, begun, rest = text.partition(begin)
    between, ended, after = rest.partition(end)
    if begun and not ended:
        raise SystemExit(f"{begin} stands without {end}")
    return (before, between, after) if begun else None


def fill(page: Path, name: str, lines: Sequence[str]) -> None:
    """Put the lines between the page's marks of this name. Raises SystemExit where it has none."""
    begin, end = marks(name)
    parts = marked(page.read_text(encoding="utf-8"), name)
    if parts is None:
        raise SystemExit(f"{page}: no markers {begin} and {end}")
    with whole(page) as draft:
        draft.write_text("\n".join([parts[0] + begin, *lines, end + parts[2]]), encoding="utf-8")


def write_page(path: Path | None, lines: Sequence[str]) -> None:
    """The Markdown page, whole or not at all; printed where there is no path.

    What the page that was there has between the marks of `READ` stays, before the first section; stderr asks
    to read it.
    """
    if path is None:
        print("\n".join(lines))
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    begin, end = marks(READ)
    if path.is_file() and (parts := marked(path.read_text(encoding="utf-8"), READ)):
        first = next((k for k, line in enumerate(lines) if line.startswith("## ")), len(lines))
        lines = [*lines[:first], begin + parts[1] + end, "", *lines[first:]]
        print(f"{path}: does what stands between {begin} and {end} still hold?", file=sys.stderr)
    with whole(path) as draft:
        draft.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


def markdown_row(cells: Sequence[str]) -> str:
    """`| a | b |`"""
    return f"| {' | '.join(cells)} |"
