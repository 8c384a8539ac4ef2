"""The documentation is short and reads fast: few words, short sentences, narrow lines."""

from __future__ import annotations

import re
from pathlib import Path
from statistics import fmean

import pytest

from tests.docs.pages import ROOT

DOCS = ROOT / "docs"
MOST_WORDS = 30_000  # without results
MOST_WORDS_OF_RESULTS = 12_000
LONGEST_MEAN = 20.0  # words a sentence
WIDEST = 100  # columns of a line of prose
COUNTED = sorted(page for page in DOCS.rglob("*.md") if DOCS / "results" not in page.parents)
RESULTS = sorted((DOCS / "results").rglob("*.md"))
OTHERS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "examples" / "ci" / "README.md"]
PAGES = [*OTHERS, *COUNTED]
NO_PROSE = re.compile(r"^ *```.*?^ *```$|<!--.*?-->", re.DOTALL | re.MULTILINE)
WORD = re.compile(r"\S*[A-Za-z]\S*")
BLOCK = re.compile(r"^\s*(?:[-*]|\d+\.)\s+", re.MULTILINE)  # an item of a list begins a block of its own
# Words of a private dialect, by design; the field's terms stand in their place.
DIALECT = re.compile(
    r"\b(?:whoever|somebody who|nobody who|errs?|erring|tuning seeds?|trying seeds?|demonstrator|pupil|forked"
    r"|our worlds?|this world|five worlds)\b",
    re.IGNORECASE,
)


def prose(page: Path) -> list[str]:
    """The lines of a page that are sentences: no code, tables, headings or link definitions."""
    text = NO_PROSE.sub("", page.read_text(encoding="utf-8"))
    return ["" if re.match(r"\s*(?:\||#|!\[|:::|\[\w+\]:)", line) else line for line in text.splitlines()]


def sentences(page: Path) -> list[str]:
    """The sentences of a page; an item of a list is one even without a full stop."""
    text = BLOCK.sub("\n\n", "\n".join(prose(page)))
    blocks = (" ".join(block.split()) for block in re.split(r"\n\s*\n", text))
    return [one for block in blocks if block for one in re.split(r"(?<=[.!?])[)*_]*\s+", block) if one]


def test_the_documentation_has_few_words() -> None:
    words = {page.name: len(page.read_text(encoding="utf-8").split()) for page in COUNTED}
    assert sum(words.values()) <= MOST_WORDS, words


def test_the_results_have_few_words() -> None:
    """Numbers and rules of tables are no words."""
    words = {page.name: len(WORD.findall(page.read_text(encoding="utf-8"))) for page in RESULTS}
    assert sum(words.values()) <= MOST_WORDS_OF_RESULTS, words


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_reads_fast(page: Path) -> None:
    assert fmean(len(sentence.split()) for sentence in sentences(page)) <= LONGEST_MEAN
    assert [line for line in prose(page) if len(line) > WIDEST] == []
    assert [found.group() for line in prose(page) for found in DIALECT.finditer(line)] == []
