"""The figures of a run, cell by cell, with intervals and counts: the content of summary.json."""

import json
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cosim.report.figures import Measure, Row, measures
from cosim.report.statistics import CONFIDENCE, mean, pooled_rate, rule_of_three, share
from cosim.types import IDENTITY, TIMINGS
from cosim.workers.tasks import OK, STATUSES

# Columns that must be equal for episodes to be counted together. Rows of different cells never are.
GROUP = tuple(name for name in IDENTITY if name not in ("policy_label", "seed"))


def summarize(
    rows: Sequence[Row],
    units: Mapping[str, str] | None = None,
    better: Mapping[str, str] | None = None,
    *,
    seed: int = 0,
) -> dict[str, Any]:
    """Plain JSON values: counts of the run, and one entry per group with its rates, means and timings.

    Figures are from episodes of status ok; `status` counts the episodes by status. Every figure has `n`, its
    number of episodes, and `na`, the number of ok episodes in which it does not apply. `seed` fixes the
    bootstrap.
    """
    known = measures(rows, units, better)
    return {
        "episodes": len(rows),
        "status": status_counts(rows),
        "not_comparable": sum(not_comparable(row) for row in rows),
        "mission_guessed": sum(mission_guessed(row) for row in rows),
        "confidence": CONFIDENCE,
        "bootstrap_seed": seed,
        "groups": [{**identity, **group_figures(members, known, seed)} for identity, members in groups(rows)],
    }


def groups(rows: Sequence[Row]) -> list[tuple[dict[str, Any], list[Row]]]:
    """The rows by scenario x demand x policy x ... (`GROUP`) and cell, in the order of the rows."""
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        found.setdefault((*(row.get(name) for name in GROUP), row.get("cell")), []).append(row)
    return [
        (
            {**dict(zip(GROUP, key[:-1], strict=True)), "cell": key[-1], "policy_label": _label(members)},
            members,
        )
        for key, members in found.items()
    ]


def group_figures(rows: Sequence[Row], known: Mapping[str, Measure], seed: int = 0) -> dict[str, Any]:
    """Counts, rates, means and timings of episodes of one group."""
    ok = [row for row in rows if row.get("status", OK) == OK]
    rates = {m.name: rate_document(m, ok) for m in known.values() if m.is_rate}
    incidences = {m.name: incidence_document(m, ok) for m in known.values() if m.per}
    means = {m.name: mean_document(m, ok, seed) for m in known.values() if not (m.is_rate or m.per)}
    return {
        "episodes": len(rows),
        "ok": len(ok),
        "status": status_counts(rows),
        "not_comparable": sum(not_comparable(row) for row in ok),
        "not_comparable_because": reasons(ok),
        "mission_guessed": sum(mission_guessed(row) for row in ok),
        "rates": rates,
        "incidences": incidences,
        "means": {name: found for name, found in means.items() if name not in TIMINGS},
        "timings": {name: found for name, found in means.items() if name in TIMINGS},
    }


def rate_document(measure: Measure, rows: Sequence[Row]) -> dict[str, Any]:
    """Share of the rows with Wilson's interval; `rule_of_three` if no row is a hit."""
    values = [v for v in measure.values(rows) if not math.isnan(v)]
    hits = int(sum(values))
    never = bool(values) and hits == 0
    return {
        **share(hits, len(values)).document(),
        "hits": hits if values else None,
        "n": len(values),
        "na": len(rows) - len(values),
        "rule_of_three": rule_of_three(len(values)) if never else None,
        "better": measure.better,
    }


def incidence_document(measure: Measure, rows: Sequence[Row]) -> dict[str, Any]:
    """Events of all rows over their exposure, with the Poisson interval."""
    tally = measure.tally(rows)
    events, exposure, weight = tally[:, ~np.isnan(tally).any(0)]
    return {
        **pooled_rate(events, exposure, weight).document(),
        "events": int(events.sum()) if len(events) else None,
        "per": measure.per,
        "exposure": measure.scale * float(exposure.sum()) if len(events) else None,
        "n": len(events),
        "na": len(rows) - len(events),
        "unit": measure.unit,
        "better": measure.better,
    }


def mean_document(measure: Measure, rows: Sequence[Row], seed: int = 0) -> dict[str, Any]:
    """Mean over the rows with its bootstrap interval."""
    values = [v for v in measure.values(rows) if not math.isnan(v)]
    return {
        **mean(values, seed).document(),
        "n": len(values),
        "na": len(rows) - len(values),
        "unit": measure.unit,
        "better": measure.better,
    }


def status_counts(rows: Sequence[Row]) -> dict[str, int]:
    """Number of episodes of each status, including zeros."""
    found = Counter(str(row.get("status", OK)) for row in rows)
    return {name: found[name] for name in (*STATUSES, *(found.keys() - set(STATUSES)))}


def not_comparable(row: Row) -> bool:
    """Whether an episode is marked as not comparable (`EpisodeResult.validity`)."""
    return row.get("status", OK) == OK and row.get("comparable") is False


def mission_guessed(row: Row) -> bool:
    """Whether the episode's mission vehicle was guessed, since neither scenario nor caller named it."""
    return bool(row.get("mission_guessed"))


def reasons(rows: Sequence[Row]) -> dict[str, int]:
    """Reasons why episodes are not comparable -> number of episodes; numbers in a reason become "n"."""
    counts: Counter[str] = Counter()
    for row in rows:
        listed = row.get("not_comparable_because") or []
        for reason in json.loads(listed) if isinstance(listed, str) else listed:
            counts[re.sub(r"(?<![\w.])\d+(\.\d+)?", "n", reason)] += 1
    return dict(counts.most_common())


def _label(rows: Sequence[Row]) -> str:
    return next((str(row["policy_label"]) for row in rows if row.get("policy_label")), "")
