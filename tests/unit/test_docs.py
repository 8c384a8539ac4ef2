"""What the documents point at is there."""

from __future__ import annotations

import inspect
import pkgutil
import re
from pathlib import Path

import pytest

import cosim.envs
from cosim.batch import spec
from cosim.errors import CosimError
from cosim.recording.file import SCHEMA
from cosim.scenario.human_errors import KINDS
from policy.agents import POLICIES

ROOT = Path(__file__).parents[2]
# The changelog names files as they were.
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").rglob("*.md")]
PAGES.remove(ROOT / "CHANGELOG.md")
MADE = {"FILE.md", "attribution.md"}  # what a command writes
FOLDERS = "docs|policy|benchmarks|tests|examples|sumo_scenarios|docker"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_pictures_and_files_named_in_a_page_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)#]+)[^)]*\)", text) if "://" not in link]
    assert [link for link in links if not (page.parent / link).exists()] == []
    files = re.findall(rf"`((?:{FOLDERS})/[\w./-]+\.\w+)`", text)
    assert [file for file in files if not (ROOT / file).exists() and "NAME" not in file] == []


# Their text is part of the identity of shipped episodes: they name pages by the paths of then.
AS_THEN = [f"sumo_scenarios/{name}.yaml" for name in ("behaviors", "errors", "tilts")]


@pytest.mark.parametrize("folder", ["benchmarks", "cosim", "policy", "sumo_scenarios"])
def test_pages_named_in_the_code_exist(folder: str) -> None:
    pages = {page.name for page in PAGES} | MADE
    named = {
        (file.relative_to(ROOT).as_posix(), name)
        for file in (ROOT / folder).rglob("*")
        if file.suffix in (".py", ".yaml", ".xml")
        for name in re.findall(r"(?:docs/)?[\w/-]*[\w-]\.md\b", file.read_text(encoding="utf-8"))
    }
    gone = {
        (file, name)
        for file, name in named
        if (not (ROOT / name).exists() if name.startswith("docs/") else Path(name).name not in pages)
    }
    assert sorted((file, name) for file, name in gone if file not in AS_THEN) == []


def test_every_figure_of_an_episode_is_defined() -> None:
    files = [*(ROOT / "cosim" / "metrics").glob("*.py"), ROOT / "cosim" / "episode.py"]
    named = {
        n for file in files for n in re.findall(r'"(\w+)": (?:Metric|self\._mean|_mean)', file.read_text())
    }
    defined = (ROOT / "docs" / "reference" / "figures.md").read_text()
    assert len(named) > 20
    assert sorted(name for name in named if f"`{name}`" not in defined) == []


@pytest.mark.parametrize(
    ("page", "names"),
    [
        ("reference/formats.md", spec.FIELDS),
        ("reference/formats.md", SCHEMA.names),
        ("reference/presets.md", tuple(POLICIES)),
        ("explanation/driver_errors.md", KINDS),
    ],
    ids=["SPEC.yaml", "recordings", "policies", "driver errors"],
)
def test_every_name_that_a_user_may_write_or_read_stands_on_its_page(
    page: str, names: tuple[str, ...]
) -> None:
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    assert [name for name in names if f"`{name}`" not in text] == []


def test_the_python_reference_lists_the_public_names_in_the_words_of_their_docstrings() -> None:
    page = (ROOT / "docs" / "reference" / "python.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `([\w.]+)` \| (.*) \|$", page, re.MULTILINE))
    found = {name: pkgutil.resolve_name(name) for name in rows}
    summaries = {name: (inspect.getdoc(of) or "").split("\n\n")[0] for name, of in found.items()}
    assert rows == {name: " ".join(text.split()) for name, text in summaries.items()}
    public = {getattr(module, name) for module in (cosim, cosim.envs) for name in module.__all__}
    errors = {of for of in vars(cosim.errors).values() if inspect.isclass(of) and issubclass(of, CosimError)}
    assert (public - {cosim.__version__}) | errors <= set(found.values())
    in_full = set(re.findall(r"^::: ([\w.]+)$", page, re.MULTILINE))
    parts = {name for name in rows if name.startswith("cosim.Session.")}
    assert in_full == {f"{found[n].__module__}.{found[n].__qualname__}" for n in rows.keys() - parts}


def test_the_glossary_is_a_line_each_in_order() -> None:
    page = (ROOT / "docs" / "reference" / "glossary.md").read_text(encoding="utf-8")
    terms = re.findall(r"^\| (.+?) \| .+ \|$", page, re.MULTILINE)[1:]
    assert 40 <= len(terms) <= 60
    assert terms == sorted(terms, key=str.lower)
