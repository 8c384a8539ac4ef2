"""The wheel alone, in an environment of its own and away from the sources: what a user installs works."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import venv
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("cosim", "policy", "sumo_scenarios")
SOURCES = (*PACKAGES, "pyproject.toml", "README.md", "LICENSE", "MANIFEST.in")
Command = Callable[..., str]


class Installed(NamedTuple):
    wheel: Path
    packages: Path  # its site-packages; no folder of ours there can hold a cache
    home: Path  # of the user; his caches are below it
    command: Command  # (arguments of cosim) -> its stdout, run in an empty folder


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    """The wheel of these sources in a fresh environment that borrows this one's dependencies."""
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
    borrowed = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    (packages / "borrowed.pth").write_text("\n".join(borrowed))
    for package in PACKAGES:  # a place where nothing can be written, for root as well
        for folder in {file.parent for file in (packages / package).rglob("*.py")}:
            (folder / "__pycache__").touch()
    home, work = base / "home", base / "work"
    home.mkdir()
    work.mkdir()
    own = {"HOME": str(home), "PYTHONPYCACHEPREFIX": str(home / "bytecode")}
    kept = {name: os.environ[name] for name in ("PATH", "LD_LIBRARY_PATH") if name in os.environ}

    def command(*arguments: object) -> str:
        return said(python.with_name("cosim"), *arguments, cwd=work, env=kept | own)

    return Installed(wheel, packages, home, command)


def said(*command: object, cwd: Path | None = None, env: dict[str, str] | None = None) -> str:
    """stdout of a command that has to succeed."""
    done = subprocess.run(list(map(str, command)), cwd=cwd, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
    return done.stdout


def test_the_wheel_holds_every_file_of_the_packages_and_nothing_else(installed: Installed) -> None:
    files = {name for name in zipfile.ZipFile(installed.wheel).namelist() if ".dist-info/" not in name}
    tracked = (file for package in PACKAGES for file in (ROOT / package).rglob("*") if file.is_file())
    wanted = {f.relative_to(ROOT).as_posix() for f in tracked if "__pycache__" not in f.parts}
    assert files == wanted
    assert {f"{package}/py.typed" for package in PACKAGES} <= files


def test_the_doctor_finds_the_installation_sound(installed: Installed) -> None:
    checks = {c["name"]: c for c in json.loads(installed.command("doctor", "--json"))["checks"]}
    assert {check["state"] for check in checks.values()} <= {"ok", "warn"}
    assert checks["cosim"]["detail"] in installed.wheel.name
    assert "merge" in checks["scenarios"]["detail"]
    assert checks["numba cache"]["detail"].startswith(str(installed.home))


def test_the_agent_drives_from_the_wheel_is_evaluated_reported_and_replayed(installed: Installed) -> None:
    python = installed.packages.parents[2] / "bin" / "python"
    where = said(python, "-P", "-c", "import cosim, policy; print(cosim.__file__, policy.__file__)", env={})
    assert all(Path(file).is_relative_to(installed.packages) for file in where.split())

    first = ("run", "merge", "--policy", "vfn-p", "--duration", "2", "--out", "one")
    installed.command(*first)
    kernels = {file: file.stat().st_mtime_ns for file in installed.home.rglob("*.nb[ci]")}
    assert kernels, "compiled kernels are kept although the installation cannot be written"
    installed.command("replay", "one", "--html", "replay.html")  # fails where the trace hash is another one
    work = installed.home.with_name("work")
    assert "<canvas" in (work / "replay.html").read_text()
    assert {file: file.stat().st_mtime_ns for file in installed.home.rglob("*.nb[ci]")} == kernels

    matrix = ("--scenario", "merge", "--policy", "idm", "--policy", "altruist-rule", "--seeds", "0:2")
    installed.command(
        "evaluate", *matrix, "--duration", "2", "--workers", "2", "--no-report", "--out", "batch"
    )
    groups = json.loads((work / "batch" / "summary.json").read_text())["groups"]
    assert sum(group["episodes"] for group in groups) == 4
    installed.command("report", "batch")
    assert (work / "batch" / "report.html").stat().st_size > 20_000
