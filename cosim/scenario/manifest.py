"""What was run, with which versions, on which files: lies beside every result."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

from cosim.scenario import Scenario

POLICY_FILES = "policy_files"  # what decides how the policy drives: weights, or its own code
# A name in the manifest -> the distribution whose version it is.
PACKAGES = {"cosim": "cosim-sumo", "libsumo": "libsumo", "numpy": "numpy", "numba": "numba", "torch": "torch"}


def manifest(scenario: Scenario, seed: int) -> dict[str, Any]:
    """A JSON document: versions, SHA-256 of every input file, seed, preset, fleet, driver model."""
    return {
        "seed": seed,
        "preset": scenario.preset,
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


def digests(files: Iterable[Path]) -> dict[str, str]:
    """Name (`named`) -> SHA-256 of each file."""
    return {name: _digest(str(path), path.stat().st_mtime_ns) for name, path in named(files).items()}


def named(files: Iterable[Path]) -> dict[str, Path]:
    """Each file by its name, or by as much of its path as tells it from the others."""
    each = list(dict.fromkeys(files))

    def end(path: Path, parts: int) -> str:
        return "/".join(path.parts[-parts:])

    found = {}
    for path in each:
        lengths = range(1, len(path.parts) + 1)
        unique = (n for n in lengths if sum(end(other, n) == end(path, n) for other in each) == 1)
        found[end(path, next(unique, len(path.parts)))] = path
    return found


@lru_cache
def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


@lru_cache(maxsize=256)
def _digest(path: str, modified: int) -> str:  # noqa: ARG001 - a changed file is hashed anew
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
