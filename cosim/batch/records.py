"""One flat row per episode: the columns of `cosim run --json`, and the episode's status. NA is None."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from cosim.batch.matrix import Cell
from cosim.scenario.options import EpisodeOptions
from cosim.scenario.policy_name import label
from cosim.types import IDENTITY
from cosim.workers.tasks import Outcome

FIRST = ("key", "cell", "status", *IDENTITY)  # in every table; then the order of `cosim run --json`
LAST = ("error", "stderr", "attempts")
_NESTED = ("units", "better", "manifest")  # equal for all episodes of a cell: stored once, in the manifest
_AS_TEXT = (
    *("timings", "collision_list", "not_comparable_because"),
    *("interventions_by_reason", "human_errors_by_kind", "human_error_list", "tilt_trials"),
)


def row(cell: Cell, case: EpisodeOptions, outcome: Outcome) -> dict[str, Any]:
    """The row of one outcome with the document of `cosim run --json` as value."""
    named = cell.scenario.identity(label(case.policy), None, case.svo_deg, case.seed)
    found = {"key": case.key, "cell": cell.name, "status": outcome.status, **asdict(named), **case.columns}
    if outcome.ok:
        found |= flat(outcome.value)
    return found | {"error": outcome.error, "stderr": outcome.stderr, "attempts": outcome.attempts}


def flat(document: Mapping[str, Any]) -> dict[str, Any]:
    """A document of `cosim run --json` as columns: timings one each, lists as JSON text."""
    found = {k: v for k, v in document.items() if k not in (*_NESTED, *_AS_TEXT)}
    found |= document["timings"]
    return found | {name: json.dumps(document[name]) for name in _AS_TEXT if name in document}


def columns(rows: Iterable[Mapping[str, Any]]) -> tuple[str, ...]:
    """Every column that any row has, in one order."""
    seen: dict[str, None] = dict.fromkeys(FIRST)
    for found in rows:
        seen.update(dict.fromkeys(name for name in found if name not in LAST))
    return (*seen, *LAST)
