"""The wheel in an environment of its own, with what the core requires and no extra: its jobs work."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import venv
import zipfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PACKAGES = ("cosim", "policy", "sumo_scenarios")
SOURCES = (*PACKAGES, "pyproject.toml", "README.md", "LICENSE", "MANIFEST.in")


class Installed(NamedTuple):
    wheel: Path
    packages: Path  # its site-packages; no folder of ours there can hold a cache
    home: Path  # the user's home; caches are below it
    work: Path  # an empty folder, in which commands run

    def python(self, *arguments: object) -> subprocess.CompletedProcess[str]:
        """What a run of this environment's Python said and returned."""
        program = self.packages.parents[2] / "bin" / "python"
        kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH") if name in os.environ}
        return subprocess.run(
            [str(program), "-P", *map(str, arguments)],
            cwd=self.work,
            env=kept | {"HOME": str(self.home)},
            capture_output=True,
            text=True,
        )

    def command(self, *arguments: object, code: int = 0) -> str:
        """stdout of a command of cosim that has to succeed, or stderr of one that has to end with `code`."""
        done = self.python("-m", "cosim.cli.main", *arguments)
        assert done.returncode == code, done.stderr[-4000:]
        return done.stderr if code else done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The wheel of these sources in a fresh environment that borrows what the core requires from this one."""
    base = tmp_path_factory.mktemp("wheel")
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy2
        options = {"ignore": shutil.ignore_patterns("__pycache__")} if (ROOT / name).is_dir() else {}
        (base / "src").mkdir(exist_ok=True)
        copy(ROOT / name, base / "src" / name, **options)  # type: ignore[operator]
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    said(*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", base / "dist", base / "src")
    (wheel,) = (base / "dist").iterdir()
    venv.create(base / "venv", symlinks=True)
    python = base / "venv" / "bin" / "python"
    said(*pip, "--python", python, "install", "--no-deps", "--no-index", "--no-compile", wheel)
    (packages,) = (base / "venv" / "lib").glob("python*/site-packages")
    (own,) = metadata.distributions(path=[str(packages)])
    for path in borrowed(own):
        (packages / path.name).symlink_to(path)
    for package in PACKAGES:  # a place where nothing can be written, for root as well
        for folder in {file.parent for file in (packages / package).rglob("*.py")}:
            (folder / "__pycache__").touch()
    for name in ("home", "work"):
        (base / name).mkdir()
    return Installed(wheel, packages, base / "home", base / "work")


def borrowed(own: metadata.Distribution) -> Iterator[Path]:
    """What the distributions that `own` requires without extras, and those that they require, installed."""
    seen, waiting = set(), required(own, set())
    for asked in waiting:  # which grows meanwhile
        if (name := canonicalize_name(asked.name)) not in seen:
            seen.add(name)
            found = metadata.distribution(asked.name)
            waiting += required(found, asked.extras)
            for top in {file.parts[0] for file in found.files or ()} - {"..", "__pycache__"}:
                yield Path(str(found.locate_file(top)))


def required(by: metadata.Distribution, extras: set[str]) -> list[Requirement]:
    """What a distribution requires here, with these of its extras."""
    asked = [Requirement(text) for text in by.requires or ()]
    return [
        a for a in asked if a.marker is None or any(a.marker.evaluate({"extra": e}) for e in extras or {""})
    ]


def said(*command: object) -> None:
    """Run a command that has to succeed."""
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]


def test_the_wheel_holds_every_file_of_the_packages_and_nothing_else(installed: Installed) -> None:
    files = {name for name in zipfile.ZipFile(installed.wheel).namelist() if ".dist-info/" not in name}
    tracked = (file for package in PACKAGES for file in (ROOT / package).rglob("*") if file.is_file())
    wanted = {f.relative_to(ROOT).as_posix() for f in tracked if "__pycache__" not in f.parts}
    assert files == wanted
    assert {f"{package}/py.typed" for package in PACKAGES} <= files


def test_the_core_drives_evaluates_compares_and_replays_without_any_extra(installed: Installed) -> None:
    where = installed.python("-c", "import cosim, policy; print(cosim.__file__, policy.__file__)").stdout
    assert all(Path(file).is_relative_to(installed.packages) for file in where.split())

    installed.command("run", "merge", "--policy", "vfn-p", "--duration", "2", "--out", "one")
    kernels = {file: file.stat().st_mtime_ns for file in installed.home.rglob("*.nb[ci]")}
    assert kernels, "compiled kernels are kept although the installation cannot be written"
    installed.command("replay", "one", "--html", "replay.html")  # fails where the trace hash is another one
    assert "<canvas" in (installed.work / "replay.html").read_text()
    assert {file: file.stat().st_mtime_ns for file in installed.home.rglob("*.nb[ci]")} == kernels
    assert "pip install 'cosim-sumo[film]'" in installed.command("replay", "one", code=2)

    matrix = ("--scenario", "merge", "--policy", "idm", "--policy", "altruist-rule", "--seeds", "0:2")
    installed.command("evaluate", *matrix, "--duration", "2", "--workers", "1", "--out", "batch")
    assert (installed.work / "batch" / "report.html").stat().st_size > 20_000
    sides = ("--baseline", "idm", "--candidate", "altruist-rule", "--fail-on", "collision_rate > 0")
    installed.command("compare", "batch", *sides, "--junit", "junit.xml")
    assert "<testcase" in (installed.work / "junit.xml").read_text()


@pytest.mark.parametrize(
    ("extra", "command"),
    [
        ("film", "run merge --out two --replay"),
        ("train", "train vfn-p --out training"),
        ("service", "serve --data service"),
        ("ray", "evaluate --scenario merge --policy idm --seeds 0:1 --engine ray --out three"),
        (
            "postgresql",
            "evaluate --scenario merge --policy idm --seeds 0:1 --store postgresql+psycopg://h/d --out three",
        ),
    ],
)
def test_what_an_extra_does_names_the_extra(installed: Installed, extra: str, command: str) -> None:
    problem = installed.command(*command.split(), code=2)
    assert problem.strip().endswith(f"pip install 'cosim-sumo[{extra}]'")
    left = {path.name for path in installed.work.iterdir()}
    assert left.isdisjoint({"two", "training", "service", "three"})


def test_the_doctor_finds_the_installation_sound(installed: Installed) -> None:
    checks = {c["name"]: c for c in json.loads(installed.command("doctor", "--json"))["checks"]}
    assert {check["state"] for check in checks.values()} <= {"ok", "warn"}
    assert checks["cosim"]["detail"] in installed.wheel.name
    assert "merge" in checks["scenarios"]["detail"]
    assert checks["numba cache"]["detail"].startswith(str(installed.home))
