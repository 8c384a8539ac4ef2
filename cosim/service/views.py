"""A session's answers as JSON: plain names and SI units, null for missing objects."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from typing import Any

import numpy as np

from cosim.envs.session import Session, StepResult
from cosim.observation.view import View
from cosim.types import KINEMATIC_FEATURES, Actor, Kind, MetaAction, Snapshot, Source

DECIMALS = 4
SOURCES = [source.name.lower() for source in Source]
_LAW = ("signal_distance", "stop_distance", "yield_distance", "crossing_distance", "person_distance")


def view(seen: View) -> dict[str, Any]:
    """One AV's observation in m, m/s, rad and s; other vehicles in the AV's frame (x ahead, y left)."""
    rules, rows = seen.rules, np.round(seen.kinematics[-1].astype(np.float64), DECIMALS).tolist()
    columns = np.round(seen.age, DECIMALS).tolist(), seen.source.tolist(), seen.indicator.tolist()
    x, y, heading = seen.pose.tolist()
    return {
        "time": seen.time,
        "decision_latency": seen.decision_latency,
        "x": x,
        "y": y,
        "heading": heading,
        "speed": seen.ego_speed,
        "target_speed": seen.target_speed,
        "lane_changing": seen.lane_changing,
        "speed_limit": seen.speed_limit,
        "to_dead_end": [*map(_ahead, seen.to_dead_end.tolist())],
        "conflict_distance": _ahead(seen.conflict_distance),
        "lane_exists": seen.lane_exists.tolist(),
        "action_mask": dict(zip(MetaAction.__members__, seen.action_mask.tolist(), strict=True)),
        "signal": rules.signal,
        "signal_switch_in": None if rules.switch_in < 0.0 else rules.switch_in,
        "all_way_stop": rules.all_way_stop,
        **{name: _ahead(getattr(rules, name)) for name in _LAW},
        "limits": [[_ahead(at), _ahead(limit)] for at, limit in rules.limits.tolist()],
        "vehicles": [
            {
                **{"id": name, **dict(zip(KINEMATIC_FEATURES, row, strict=True))},
                **{"age": age, "source": SOURCES[source], "indicator": indicator},
            }
            for name, row, known, age, source, indicator in zip(
                seen.ids, rows, seen.valid[-1].tolist(), *columns, strict=True
            )
            if known
        ],
    }


def step(session: Session, result: StepResult | None) -> dict[str, Any]:
    """The result of a reset (`result` is None) or an act."""
    found: dict[str, Any] = {
        "seed": session.seed,
        "elapsed": session.elapsed,
        "over": session.over,
        "avs": list(session.avs),
        "observations": {av: view(seen) for av, seen in session.observe().items()},
        "events": asdict(session.events),
    }
    if result is not None:
        found |= {
            "rewards": result.rewards,
            "terms": {av: terms._asdict() for av, terms in result.terms.items()},
            "terminated": result.terminated,
            "truncated": result.truncated,
            "ended": result.ended,
            "receipts": {
                av: {"executed": r.executed, "blocked": r.blocked} for av, r in result.receipts.items()
            },
        }
    return found


def snapshot(now: Snapshot) -> dict[str, Any]:
    """Every vehicle and person, and the state of every signal, as the simulation has them."""
    columns = {
        name: np.round(getattr(now, name), DECIMALS).tolist()
        for name in ("x", "y", "heading", "speed", "accel", "length", "width")
    }
    return {
        "time": now.time,
        "signals": "".join(map(chr, now.signals.tolist())),
        "vehicles": [
            {
                "id": name,
                "kind": Kind(now.kind[k]).name.lower(),
                "actor": Actor(now.actor[k]).name.lower(),
                "mission": bool(now.mission[k]),
                "lane": int(now.lane[k]),
                "indicator": int(now.indicator[k]),
                **{column: values[k] for column, values in columns.items()},
            }
            for k, name in enumerate(now.ids)
        ],
    }


def to_json(document: Any) -> bytes:
    """Standard JSON; numbers that are not finite become null."""
    try:
        return json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
    except ValueError:
        return json.dumps(_finite(document), allow_nan=False, separators=(",", ":")).encode()


def _ahead(distance: float) -> float | None:
    """The distance in m; None if it is infinite."""
    return distance if math.isfinite(distance) else None


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    return [_finite(item) for item in value] if isinstance(value, list | tuple) else value
