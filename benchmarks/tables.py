"""Markdown pages of benchmarks: table rows, pages, and parts of a page between marks."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from cosim.files import whole

READ = "read"  # marks around the interpretation of the figures, written by hand


def marks(name: str) -> tuple[str, str]:
    """The marks before and after a part of a page that is kept or replaced separately."""
    return f"<!-- {name} -->", f"<!-- end of {name} -->"


def marked(text: str, name: str) -> tuple[str, str, str] | None:
    """The text before, between and after the marks of this name; None without marks.

    Raises SystemExit if the end mark is missing, so that handwritten text is not lost.
    """
    begin, end = marks(name)
    before, begun, rest = text.partition(begin)
    between, ended, after = rest.partition(end)
    if begun and not ended:
        raise SystemExit(f"{begin} has no {end} after it")
    return (before, between, after) if begun else None


def fill(page: Path, name: str, lines: Sequence[str]) -> None:
    """Put the lines between the page's marks of this name. Raises SystemExit without these marks."""
    begin, end = marks(name)
    parts = marked(page.read_text(encoding="utf-8"), name)
    if parts is None:
        raise SystemExit(f"{page}: no markers {begin} and {end}")
    with whole(page) as draft:
        draft.write_text("\n".join([parts[0] + begin, *lines, end + parts[2]]), encoding="utf-8")


def write_page(path: Path | None, lines: Sequence[str]) -> None:
    """Write a Markdown page atomically; print it if `path` is None.

    Text between the marks of `READ` on the old page is kept before the first section, with a reminder on
    stderr to check it.
    """
    if path is None:
        print("\n".join(lines))
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    begin, end = marks(READ)
    if path.is_file() and (parts := marked(path.read_text(encoding="utf-8"), READ)):
        first = next((k for k, line in enumerate(lines) if line.startswith("## ")), len(lines))
        lines = [*lines[:first], begin + parts[1] + end, "", *lines[first:]]
        print(f"{path}: check whether the text between {begin} and {end} still holds", file=sys.stderr)
    with whole(path) as draft:
        draft.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


def markdown_row(cells: Sequence[str]) -> str:
    """`| a | b |`"""
    return f"| {' | '.join(cells)} |"


def markdown_head(columns: Sequence[str]) -> list[str]:
    """The first two lines of a table."""
    return [markdown_row(columns), "|---" * len(columns) + "|"]
