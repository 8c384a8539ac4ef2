"""The rows of a run in the order of the report: blocks of equal traffic, each with a series per policy.

The report compares only figures of one block, whose series drove the same traffic on the same seeds.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from cosim.report.compare import PairedFigure, paired
from cosim.report.figures import Measure, Row
from cosim.report.run_folder import Run
from cosim.report.summary import GROUP, group_figures, groups
from cosim.workers.tasks import OK

BASELINE = "idm"  # of the papers: AVs without commands
TRAFFIC = tuple(name for name in GROUP if name not in ("policy", "svo_deg"))


@dataclass(frozen=True)
class Series:
    """One cell: a policy with one SVO in one traffic."""

    identity: dict[str, Any]  # by the names of `GROUP`, and cell, policy_label
    rows: list[Row]
    known: dict[str, Measure]
    label: str  # distinct within the block
    colour: int  # the policy's index in the run

    @cached_property
    def ok(self) -> list[Row]:
        """Episodes with figures."""
        return [row for row in self.rows if row["status"] == OK]

    @cached_property
    def figures(self) -> dict[str, Any]:
        """Counts, rates, incidences and means (`summary.group_figures`)."""
        return group_figures(self.rows, self.known)

    def counts(self, name: str) -> dict[str, Any]:
        """Value, interval and counts of one measure; {} if the run does not have it."""
        kinds = (self.figures[kind] for kind in ("rates", "incidences", "means", "timings"))
        return next((kind[name] for kind in kinds if name in kind), {})

    def values(self, name: str) -> list[float]:
        """One measure of every ok episode, nan for NA."""
        return self.known[name].values(self.ok) if name in self.known else []


@dataclass(frozen=True)
class Difference:
    """A series against the baseline of its block, on equal seeds."""

    series: Series
    baseline: Series
    figures: dict[str, PairedFigure]
    pairs: int


@dataclass(frozen=True)
class Block:
    """Series that drove the same traffic."""

    identity: dict[str, Any]  # by the names of `TRAFFIC`
    series: list[Series]

    def differences(self, names: Iterable[str]) -> list[Difference]:
        """Every other series against the baseline: `idm`, if possible at its SVO, else the first series."""
        names = tuple(names)
        baselines = [s for s in self.series if s.identity["policy"] == BASELINE]
        differences = []
        for series in self.series:
            same_svo = [s for s in baselines if s.identity["svo_deg"] == series.identity["svo_deg"]]
            baseline = [*same_svo, *baselines, *self.series][0]
            if series is baseline or series in baselines:
                continue
            before = {row["seed"]: row for row in baseline.ok}
            if pairs := [(before[row["seed"]], row) for row in series.ok if row["seed"] in before]:
                figures = {n: paired(series.known[n], pairs) for n in names if n in series.known}
                differences.append(Difference(series, baseline, figures, len(pairs)))
        return differences


def blocks(run: Run) -> list[Block]:
    """The run's cells by traffic, in the order of the rows."""
    by_traffic: dict[str, list[tuple[dict[str, Any], list[Row]]]] = {}
    for identity, rows in groups(run.rows):
        case = {k: v for k, v in run.case(rows[0]).items() if k not in ("svo_deg", "outputs")}
        traffic = [identity[name] for name in TRAFFIC]
        key = json.dumps([traffic, case], sort_keys=True, default=str)
        by_traffic.setdefault(key, []).append((identity, rows))
    colours = {policy: k for k, policy in enumerate(run.policies)}
    return [
        Block(
            {name: members[0][0][name] for name in TRAFFIC},
            [
                Series(identity, rows, run.measures, label, colours[identity["policy"]])
                for (identity, rows), label in zip(members, _labels([i for i, _ in members]), strict=True)
            ],
        )
        for members in by_traffic.values()
    ]


def _labels(identities: list[dict[str, Any]]) -> list[str]:
    """The policy; with its SVO if the block has several; with its cell if labels would still be equal."""
    several = len({identity["svo_deg"] for identity in identities}) > 1
    labels = [
        f"{i['policy']} {i['svo_deg']:g}°" if several and i["svo_deg"] is not None else str(i["policy"])
        for i in identities
    ]
    return [
        f"{label} ({i['cell']})" if labels.count(label) > 1 else label
        for label, i in zip(labels, identities, strict=True)
    ]
