"""The README is short, its commands exist, and its Python runs as it stands."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from cosim.cli.main import parser
from tests.docs.pages import ROOT, blocks, shell

README = ROOT / "README.md"


def test_it_is_short() -> None:
    assert len(README.read_text(encoding="utf-8").split()) <= 700


def test_its_commands_exist() -> None:
    """`make` has each target, and `cosim` understands each line."""
    (lines,) = (block.text for block in blocks(README) if block.language == "sh")
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    named = []
    for line in lines.splitlines():
        program, *arguments = shlex.split(line, comments=True)
        if program == "make":
            assert arguments[0] in targets
            named += arguments
        else:
            assert program == ".venv/bin/cosim"
            parser(arguments[0]).parse_args(arguments)
    assert {"demo", "test"} <= set(named)


def test_every_finding_says_yes_no_or_not_shown_and_names_its_page() -> None:
    text = README.read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith("| ") and "?" in line]
    assert len(rows) == 5
    finding = re.compile(r"\| \*\*(Yes|No|Not shown)\*\*.*\(\[page\]\(docs/results/\w+\.md\)\)")
    assert all(finding.search(row) for row in rows)


@pytest.mark.parametrize("number", range(2))
def test_its_python_runs_as_a_file(number: int, tmp_path: Path) -> None:
    snippets = [block.text for block in blocks(README) if block.language == "python"]
    assert len(snippets) == 2
    (tmp_path / "user.py").write_text(snippets[number], encoding="utf-8")
    printed = shell("python -W ignore user.py", tmp_path)
    if number == 0:
        assert re.fullmatch(r"Metric\(value=[\d.]+, unit='s', better='lower'\)\n", printed)
