"""The manifest of a result: options, versions, and digests of the input files."""

import hashlib
import platform
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

from cosim.errors import inside
from cosim.files.yaml_input import mapping, value_of
from cosim.scenario import Scenario
from cosim.scenario.human_errors import Errors
from cosim.scenario.options import EpisodeOptions
from cosim.scenario.sensing import Sensing
from cosim.scenario.sumocfg import CLOCK, INPUTS, command_line, keeps
from cosim.types import OnCollision

POLICY_FILES = "policy_files"  # the policy's weights or code
_KINDS: Mapping[str, Any] = {  # types of the fields that cosim reads back from manifests
    **dict.fromkeys(("files", POLICY_FILES, "sumo_options", "units", "better"), Mapping[str, str]),
    "versions": Mapping[str, str | None],
    "traffic": str,
    "changed_options": Mapping[str, Mapping[str, str]],
    "sumo_arguments": tuple[str, ...],
    "seed": int,
    "seeds": tuple[int, int],
    "trace_hash": str,
}
CASE, OPTIONS = "case", "sumo_arguments"  # fields added by `cosim run --out`
TRACI = "traci"  # replaces these fields in a simulation shared with other TraCI clients
# Name in the manifest -> distribution package.
PACKAGES = {"cosim": "cosim-sumo", "libsumo": "libsumo", "numpy": "numpy", "numba": "numba", "torch": "torch"}


def manifest(scenario: Scenario, seed: int) -> dict[str, Any]:
    """A JSON document: versions, SHA-256 of every input file, seed, preset, fleet, driver model."""
    return {
        "seed": seed,
        "preset": scenario.preset,
        # only values that differ from a scenario folder's own: this document identifies old episodes too
        **({"on_collision": goes_on} if (goes_on := scenario.on_collision) != OnCollision.END else {}),
        **({} if scenario.built_in else {"mission": scenario.mission.vehicles or scenario.mission.kind}),
        **({} if scenario.built_in else {"traffic": scenario.traffic}),
        **({"changed_options": _changed(scenario)} if scenario.changed else {}),
        **({} if scenario.errors is None else {"errors": _errors(scenario.errors)}),
        **({} if scenario.sensing is None else {"sensing": _sensing(scenario.sensing)}),
        **({} if scenario.tilt is None else {"tilt": scenario.tilt.text()}),
        "driver_model": scenario.driver_model,
        "behavior": scenario.behavior,
        "fleet": scenario.fleet.describe(),
        "timing": {
            "step_s": scenario.timing.step,
            "frame_s": scenario.timing.frame,
            "decision_s": scenario.timing.decision,
            "begin_s": scenario.begin,
            "warmup_s": scenario.warmup,
            "duration_s": scenario.duration,
        },
        "sumo_options": dict(scenario.options),
        "options_not_passed_on": list(scenario.ignored),
        "versions": {
            "python": platform.python_version(),
            **{name: _version(distribution) for name, distribution in PACKAGES.items()},
        },
        "files": digests(scenario.files),
    }


def checked(document: object, file: Path, where: str = "") -> dict[str, Any]:
    """`document`, the manifest at `where` in `file`, with checked types of the fields that cosim reads back.

    Raises:
        BadInput: a field of another type, in the manifest or in those of its cells.
    """
    with inside(where, file):
        found = mapping(document)
        for name in found.keys() & _KINDS.keys():
            with inside(name):
                value_of(_KINDS[name], found[name])
    cells = checked(found["cells"], file, "cells") if "cells" in found else {}
    for name in cells:
        cell = checked(cells[name], file, f"cells.{name}")
        for part in cell.keys() & {"case", "manifest"}:
            checked(cell[part], file, f"cells.{name}.{part}")
    return found


def remembered(case: EpisodeOptions, options: Sequence[str]) -> dict[str, Any]:
    """The additional manifest fields from which `cosim replay` repeats the episode.

    Without outputs: a replay does not write them again.
    """
    kept: list[str] = []
    for name, value in command_line(options).items():
        if name in INPUTS:
            value = ",".join(str(Path(part.strip()).absolute()) for part in value.split(","))
        if name in (*INPUTS, *CLOCK) or keeps(name):
            kept += [f"--{name}={value}"]
    return {CASE: case.document(), OPTIONS: kept}


def digests(files: Iterable[Path]) -> dict[str, str]:
    """Name (`named`) -> SHA-256 of each file."""
    return {name: _digest(str(path), path.stat().st_mtime_ns) for name, path in named(files).items()}


def named(files: Iterable[Path]) -> dict[str, Path]:
    """Each file by its name, extended by as many parent folders as make the names unique."""
    each = list(dict.fromkeys(files))

    def end(path: Path, parts: int) -> str:
        return "/".join(path.parts[-parts:])

    found = {}
    for path in each:
        lengths = range(1, len(path.parts) + 1)
        unique = (n for n in lengths if sum(end(other, n) == end(path, n) for other in each) == 1)
        found[end(path, next(unique, len(path.parts)))] = path
    return found


def _changed(scenario: Scenario) -> dict[str, dict[str, str]]:
    """SUMO option -> the file's value, the used value, and the reason."""
    return {c.option: {"file": c.file, "used": c.used, "why": c.why} for c in scenario.changed}


def _errors(errors: Errors) -> dict[str, str]:
    return {"name": errors.name, "sha256": errors.digest}


def _sensing(sensing: Sensing) -> dict[str, str]:
    return {"name": sensing.name, "sha256": sensing.digest}


@lru_cache
def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


@lru_cache(maxsize=256)
def _digest(path: str, modified: int) -> str:  # noqa: ARG001 - a changed file is hashed anew
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
