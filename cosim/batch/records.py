"""One flat row per episode: the columns of `cosim run --json`, and what became of the episode. NA is None."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from cosim.batch.matrix import Cell
from cosim.scenario.episode_id import Case
from cosim.scenario.policy_name import label
from cosim.workers.tasks import Outcome

# First in every table; all others follow in the order of `cosim run --json`.
IDENTITY = (
    "key",
    "cell",
    "status",
    "scenario",
    "demand",
    "policy",
    "policy_label",
    "behavior",
    "driver_model",
    "penetration",
    "preset",
    "svo_deg",
    "seed",
)
LAST = ("error", "stderr", "attempts")
_NESTED = ("units", "better", "manifest")  # the same for all episodes of a cell: kept once, in the manifest
_AS_TEXT = ("timings", "collision_list", "not_comparable_because")


def row(cell: Cell, case: Case, outcome: Outcome) -> dict[str, Any]:
    """The row of one outcome, whose value is the document of `cosim run --json`."""
    scenario = cell.scenario
    found: dict[str, Any] = {
        "key": case.key,
        "cell": cell.name,
        "status": outcome.status,
        "scenario": scenario.name,
        "demand": scenario.demand_name,
        "policy": label(case.policy),
        "policy_label": None,
        "behavior": scenario.behavior,
        "driver_model": scenario.driver_model,
        "penetration": case.penetration,
        "preset": scenario.preset,
        "svo_deg": case.svo_deg,
        "seed": case.seed,
    }
    if outcome.ok:
        found |= flat(outcome.value)
    return found | {"error": outcome.error, "stderr": outcome.stderr, "attempts": outcome.attempts}


def flat(document: Mapping[str, Any]) -> dict[str, Any]:
    """A document of `cosim run --json` as columns: timings one each, lists as JSON text."""
    found = {k: v for k, v in document.items() if k not in (*_NESTED, *_AS_TEXT)}
    found |= document["timings"]
    return found | {name: json.dumps(document[name]) for name in _AS_TEXT}


def columns(rows: Iterable[Mapping[str, Any]]) -> tuple[str, ...]:
    """Every column that any row has, in one order."""
    seen: dict[str, None] = dict.fromkeys(IDENTITY)
    for found in rows:
        seen.update(dict.fromkeys(name for name in found if name not in LAST))
    return (*seen, *LAST)
