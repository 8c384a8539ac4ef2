"""The documentation site builds strictly, its links lead somewhere, and nothing is loaded from elsewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from cosim.cli import COMMANDS
from cosim.cli.reference import PLACEHOLDER
from tests.service.browser import Tab, launched, needed

ROOT = Path(__file__).parents[2]
LOADS = {
    ("script", "src"),
    ("img", "src"),
    ("iframe", "src"),
    ("source", "src"),
    ("video", "src"),
    ("link", "href"),
}
NO_LOAD = {"canonical", "next", "prev", "alternate"}  # `rel` of <link>s that fetch nothing


class Page(HTMLParser):
    """The addresses that a page loads from and links to, and the anchors that it has."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.file = file
        self.loads: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(file.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        of = dict(attrs)
        self.anchors.add(of.get("id") or "")
        for name, value in attrs:
            if (tag, name) in LOADS and of.get("rel") not in NO_LOAD:
                self.loads.append(value or "")
            elif tag == "a" and name == "href":
                self.links.append(value or "")

    def missing(self, address: str) -> bool:
        """Whether an address of the site itself leads to no file."""
        to = urlsplit(address)
        return (
            not (to.scheme or to.netloc)
            and bool(to.path)
            and not (self.file.parent / unquote(to.path)).exists()
        )


@pytest.fixture(scope="module")
def site() -> Path:
    build = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    done = subprocess.run(
        build, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return ROOT / "site"


@pytest.fixture(scope="module")
def pages(site: Path) -> list[Page]:
    return [Page(file) for file in site.rglob("*.html") if file.name != "404.html"]


def test_every_link_and_picture_of_the_site_leads_to_a_file(pages: list[Page], site: Path) -> None:
    assert len(pages) > 40
    lost = [(str(p.file.relative_to(site)), to) for p in pages for to in p.links + p.loads if p.missing(to)]
    assert lost == []


def test_every_link_to_a_heading_finds_it(pages: list[Page], site: Path) -> None:
    anchors = {p.file: p.anchors for p in pages}
    lost = []
    for page in pages:
        for link in page.links:
            to = urlsplit(link)
            file = (page.file.parent / unquote(to.path)).resolve() if to.path else page.file
            if not to.netloc and to.fragment and unquote(to.fragment) not in anchors.get(file, {to.fragment}):
                lost.append((str(page.file.relative_to(site)), link))
    assert lost == []


def test_no_page_loads_anything_from_elsewhere(pages: list[Page], site: Path) -> None:
    assert [(p.file.name, to) for p in pages for to in p.loads if urlsplit(to).netloc] == []
    styles = "".join(file.read_text() for file in site.rglob("*.css"))
    assert re.findall(r"""(?:url\(|@import)\s*['"]?(?:https?:)?//""", styles) == []
    marked = "".join(p.file.read_text() for p in pages)
    # The theme's script fetches for these alone: diagrams, galleries, code that runs, a repository's stars.
    assert re.findall(r'class="(?:mermaid|glightbox|pyodide)\b|data-md-component="source"', marked) == []


@needed
@pytest.mark.parametrize("wide", [1280, 420])
def test_a_browser_searches_the_site_from_a_disk_and_asks_nobody(site: Path, wide: int) -> None:
    with launched() as browser:
        tab = Tab(browser, wide=wide)
        tab.page.goto((site / "reference" / "figures.html").as_uri())
        assert tab.page.evaluate("document.documentElement.scrollWidth") <= wide
        tab.page.locator("label[for=__search]:visible, .md-search__button:visible").first.click()
        tab.page.keyboard.insert_text("near-miss")  # at once: no results of a part of it
        tab.page.get_by_text(re.compile(r"\d+ results")).wait_for()
        tab.page.keyboard.press("Enter")
        tab.page.wait_for_url("**/figures.html*#near-misses")
        assert tab.wrong == []
        assert {urlsplit(url).scheme for url in tab.asked} <= {"file", "data", "blob", "about"}


def test_the_command_line_is_written_from_the_parser(site: Path) -> None:
    page = (site / "reference" / "command_line.html").read_text(encoding="utf-8")
    assert [name for name in COMMANDS if f'id="cosim-{name}"' not in page] == []
    assert "--on-collision" in page
    assert PLACEHOLDER not in page


def test_the_python_reference_is_written_from_the_docstrings(site: Path) -> None:
    page = (site / "reference" / "python.html").read_text(encoding="utf-8")
    for name in ("cosim.envs.session.open", "cosim.types.MetaAction", "cosim.observation.view.View"):
        assert f'id="{name}"' in page
    assert "must be an angle" not in page, "docstrings, not source"
