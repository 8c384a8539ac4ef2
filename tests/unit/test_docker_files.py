"""The recipe of the container: locked up, pinned, and free of this or any other machine's places."""

import importlib.util
import re
import subprocess
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[2]
DOCKER = ROOT / "docker"
SCRIPTS = sorted(DOCKER.glob("*.sh"))
SHIPPED = sorted(path for path in DOCKER.rglob("*") if path.is_file() and "__pycache__" not in path.parts)


def module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"docker_{name}", DOCKER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def instructions() -> list[tuple[str, str]]:
    """(INSTRUCTION, rest) of the Dockerfile, continued lines joined, comments left out."""
    lines = [s for s in (DOCKER / "Dockerfile").read_text().splitlines() if not s.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", " ", "\n".join(lines))
    return [
        (word.upper(), rest) for word, _, rest in (s.partition(" ") for s in joined.splitlines() if s.strip())
    ]


def stages() -> dict[str, list[tuple[str, str]]]:
    found: dict[str, list[tuple[str, str]]] = {}
    name = ""
    for word, rest in instructions():
        if word == "FROM":
            name = rest.split(" AS ")[1]
        found.setdefault(name, []).append((word, rest))
    return found


@pytest.mark.parametrize("target", ["runtime", "test"])
def test_an_image_runs_as_nobody_in_particular_under_an_init(target: str) -> None:
    words = dict(stages()[target])
    uid, gid = words["USER"].split(":")
    assert int(uid) > 0
    assert int(gid) > 0
    assert words["ENTRYPOINT"].startswith('["tini", "--", "with-caches", ')


def test_the_runtime_is_the_default_target_and_calls_cosim() -> None:
    assert list(stages())[-1] == "runtime"
    assert dict(stages()["runtime"])["ENTRYPOINT"].endswith('"cosim"]')


def test_what_is_shipped_takes_no_build_setting_along() -> None:
    for target in ("system", "runtime", "test"):
        words = [word for word, _ in stages()[target]]
        named = " ".join(rest for word, rest in stages()[target] if word in ("ARG", "ENV"))
        assert "PIP_" not in named, target
        assert "ADD" not in words, target


def test_every_installation_by_pip_keeps_to_the_tested_set() -> None:
    runs = [rest for word, rest in instructions() if word == "RUN"]
    installs = [piece for rest in runs for piece in rest.split("&&") if "pip install" in piece]
    assert len(installs) >= 4
    for piece in installs:
        assert "--constraint constraints.txt" in piece or "--no-deps" in piece, piece


def test_what_the_dockerfile_copies_is_there_and_not_ignored() -> None:
    ignored = {s for s in (ROOT / ".dockerignore").read_text().splitlines() if s and not s.startswith("#")}
    assert {".git", "**/__pycache__", "runs", ".venv"} <= ignored
    for word, rest in instructions():
        if word == "COPY" and "--from" not in rest:
            for source in rest.split()[:-1]:
                assert (ROOT / source).exists(), source
                assert source.split("/")[0] not in ignored, source


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: str(p.relative_to(DOCKER)))
def test_no_host_no_secret_and_no_place_of_a_machine(path: Path) -> None:
    text = path.read_text()
    assert not re.search(r"https?://", text)
    assert not re.search(r"(?i)(password|secret|api[_-]?key)\s*[=:]\s*\S", text)
    assert not re.search(r"/(root|home/\w+|opt/(?!cosim)\w+)\b", text)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda p: p.name)
def test_a_script_is_sound_and_stops_at_the_first_error(path: Path) -> None:
    first, *_ = path.read_text().splitlines()
    shell = "sh" if first == "#!/bin/sh" else "bash"
    subprocess.run([shell, "-n", str(path)], check=True)
    if first.startswith("#!"):
        assert path.stat().st_mode & 0o111, "not executable"
        assert re.search(r"^set -eu", path.read_text(), re.MULTILINE)


def compose() -> dict[str, dict[str, Any]]:
    services = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]
    assert {"doctor", "evaluate", "gate", "report"} <= set(services)
    return services


@pytest.mark.parametrize("name", sorted(compose()))
def test_every_service_is_locked_up(name: str) -> None:
    service = compose()[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["network_mode"] == "none"
    assert "ports" not in service
    assert "privileged" not in service
    assert {"mem_limit", "cpus", "pids_limit"} <= set(service)
    assert [str(mount).split(":")[0] for mount in service["tmpfs"]] == ["/tmp"]
    scenarios, results = service["volumes"]
    assert str(scenarios).endswith(":/scenarios:ro")
    assert str(results).endswith(":/results")


@pytest.mark.parametrize("name", sorted(compose()))
def test_every_service_says_what_the_command_line_understands(name: str) -> None:
    from cosim.cli.main import parser

    command = [re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", word) for word in compose()[name]["command"]]
    assert callable(parser().parse_args(command).work)


def test_an_extra_that_names_others_is_unfolded() -> None:
    project = {
        "name": "cosim-sumo",
        "dependencies": ["numpy>=1"],
        "optional-dependencies": {
            "ray": ["ray>=2"],
            "all": ["cosim-sumo[ray, dev]"],
            "dev": ["pytest", "numpy>=1"],
        },
    }
    listed = module("dependencies").dependencies
    assert listed(project, []) == ["numpy>=1"]
    assert listed(project, ["all"]) == ["numpy>=1", "ray>=2", "pytest"]
    with pytest.raises(KeyError, match="rai"):
        listed(project, ["rai"])


def test_the_build_borrows_pip_settings_without_naming_a_place_of_the_host() -> None:
    host_pip = module("host_pip")
    listing = "\n".join(
        [
            "global.find-links='/somewhere/wheels'",
            "global.extra-index-url='file:///mirror/simple https://packages.example/simple'",
            "user.timeout='10'",
            ":env:.timeout='60'",
            "global.cert='/somewhere/ca.pem'",
            "freeze.timeout='1'",
        ]
    )
    text, mounts, bundle = host_pip.lend(host_pip.settings(listing))
    assert mounts == {"/mirror": "/run/host-pip-0", "/somewhere/wheels": "/run/host-pip-1"}
    assert "extra-index-url = file:///run/host-pip-0/simple https://packages.example/simple\n" in text
    assert "find-links = /run/host-pip-1\n" in text
    assert "timeout = 60\n" in text
    assert "cert = /run/host-pip/ca.pem\n" in text
    assert "somewhere" not in text
    assert bundle == "/somewhere/ca.pem"
