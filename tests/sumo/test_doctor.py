"""`cosim doctor` says what is there, what is wrong and how to fix it."""

import json
import os
from argparse import Namespace
from pathlib import Path

import pytest

from cosim.cli import doctor
from cosim.cli.doctor import FAIL, OK, WARN
from cosim.service import confined


def test_a_sound_installation_passes_with_a_simulated_second(capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor.work(Namespace(json=True, scenario=None)) == 0
    report = json.loads(capsys.readouterr().out)
    checks = {check["name"]: check for check in report["checks"]}
    assert report["failed"] == 0
    assert checks["libsumo"]["detail"] == checks["sumolib"]["detail"] == "1.28.0"
    assert "simulated 1 s" in checks["simulation"]["detail"]
    assert "merge" in checks["scenarios"]["detail"]


def test_one_failure_makes_the_exit_code_3(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    checks = [doctor.Check("a", OK, "1"), doctor.Check("b", FAIL, "gone", "fetch it")]
    monkeypatch.setattr(doctor, "examine", lambda _: iter(checks))
    assert doctor.work(Namespace(json=False, scenario=None)) == 3
    assert capsys.readouterr().out == "ok   a: 1\nFAIL b: gone (fetch it)\n"


def test_a_missing_system_library_comes_with_the_apt_line() -> None:
    stderr = "ImportError: libX11.so.6: cannot open shared object file: No such file or directory"
    detail, fix = doctor.explain_import(1, stderr)
    assert "libX11.so.6" in detail
    assert fix.startswith("apt-get install")
    assert "libx11-6" in fix


def test_a_sumo_package_of_another_version_is_named() -> None:
    versions = {"libsumo": "1.28.0", "sumolib": "1.27.0", "traci": "1.26.0"}
    checks = {check.name: check for check in doctor.sumo_packages(versions.get)}
    assert checks["libsumo"].state == OK
    assert checks["sumolib"].state == FAIL
    assert checks["traci"].state == WARN
    assert "pip install sumolib==1.28.0" in checks["sumolib"].fix
    assert checks["eclipse-sumo"].state == WARN


def test_missing_packages_are_listed_with_the_line_that_installs_them() -> None:
    versions = {"cosim-sumo": "0.1.0", "numpy": "2.0"}
    checks = list(doctor.packages(versions.get))
    assert [check.state for check in checks] == [OK, FAIL, OK]
    assert "torch" in checks[1].detail
    assert "torch" in checks[1].fix


def test_another_sumo_on_the_path_and_a_wrong_sumo_home_are_warnings(tmp_path: Path) -> None:
    old = tmp_path / "sumo"
    old.write_text("#!/bin/sh\necho 'Eclipse SUMO sumo Version 1.18.0'\n")
    old.chmod(0o755)
    environment = {"PATH": f"{tmp_path}{os.pathsep}{tmp_path}", "SUMO_HOME": str(tmp_path / "gone")}
    copy, home = doctor.sumo_copies(environment, "1.28.0")
    assert (copy.name, copy.state) == ("sumo", WARN)
    assert "1.18.0" in copy.detail
    assert (home.name, home.state) == ("SUMO_HOME", WARN)
    assert not list(doctor.sumo_copies({"PATH": str(tmp_path / "empty")}, "1.28.0"))


def test_a_numba_cache_that_cannot_be_written_is_a_warning(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    assert doctor.numba_cache({"NUMBA_CACHE_DIR": str(tmp_path)}).state == OK
    broken = doctor.numba_cache({"NUMBA_CACHE_DIR": str(file / "cache")})
    assert broken.state == WARN
    assert "NUMBA_CACHE_DIR" in broken.fix


def test_whether_uploads_can_be_confined_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.confinement().state == OK
    monkeypatch.setattr(confined, "lacking", lambda: "this kernel has no seccomp")
    found = doctor.confinement()
    assert (found.state, found.detail) == (WARN, "this kernel has no seccomp: cosim serve takes none")
