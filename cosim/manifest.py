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
PACKAGES = ("cosim", "libsumo", "numpy", "numba", "torch")


def manifest(scenario: Scenario, seed: int) -> dict[str, Any]:
    """A JSON document: versions, SHA-256 of every input file, seed, preset, fleet, driver model."""
    files = (scenario.config, scenario.net, *scenario.demand, *scenario.additional)
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
            "warmup_s": scenario.warmup,
            "duration_s": scenario.duration,
        },
        "sumo_options": dict(scenario.options),
        "options_not_passed_on": list(scenario.ignored),
        "versions": {"python": platform.python_version(), **{p: _version(p) for p in PACKAGES}},
        "files": digests(files),
    }


def digests(files: Iterable[Path]) -> dict[str, str]:
    """Name -> SHA-256 of each file."""
    return {path.name: _digest(str(path), path.stat().st_mtime_ns) for path in files}


@lru_cache
def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


@lru_cache(maxsize=256)
def _digest(path: str, modified: int) -> str:  # noqa: ARG001 - a changed file is hashed anew
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
