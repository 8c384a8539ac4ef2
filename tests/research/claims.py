"""A small claim as a file, and arms of made-up episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import yaml

from research.drive import Arm, Arms
from research.schema import Claim, Condition, read

SMALL: dict[str, Any] = {
    "sentence": "A script lets more mission vehicles through",
    "source": "ours",
    "scenarios": ["merge", "exit"],
    "seeds": {"first": 300_000, "count": 40},
    "options": {"preset": "unguarded", "demand": "contested"},
    "arms": {"rule": {"policy": "altruist-rule"}, "idm": {"policy": "idm"}},
    "floors": {"lane": {"policy": "keep-lane"}},
    "compare": {"arm": "rule", "against": "idm"},
    "primary": {"metric": "collision_rate", "direction": "lower"},
    "test": "mcnemar",
    "power": {"smallest": 0.1, "pairs": 40},
    "secondary": ["dt_mean_m"],
}


def written(folder: Path, name: str = "small", **changes: Any) -> Path:
    """The file of `SMALL` with other fields."""
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump({**SMALL, **changes}, sort_keys=False))
    return path


def claim(folder: Path, **changes: Any) -> Claim:
    """`SMALL` with other fields, read."""
    return read(written(folder, **changes))


def rows(crashed: Sequence[int], n: int, distance: float = 100.0, **more: Any) -> tuple[dict[str, Any], ...]:
    """n episodes, of which those with these numbers crashed."""
    return tuple(
        {
            "status": "ok", "seed": k, "crashed": k in crashed, "dt_mean_m": distance + k % 3,
            "preset": "unguarded", "behavior": "mixed", **more,
        }
        for k in range(n)
    )  # fmt: skip


def arms(of: Mapping[tuple[str, str], Sequence[Mapping[str, Any]]]) -> Arms:
    """(scenario, arm) -> rows as the engine holds them."""
    found = {}
    for (scenario, name), mine in of.items():
        cell: Any = SimpleNamespace(
            case=SimpleNamespace(policy=f"{name}#mark"), manifest={"policy_files": {}}
        )
        weights = "" if name == "idm" else "0123456789ab"
        found[Condition(scenario), name] = Arm(
            cell, range(len(mine)), weights, "definitions", "", tuple(mine)
        )
    return found
