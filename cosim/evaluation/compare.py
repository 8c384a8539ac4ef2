"""A against B on equal traffic: pairs of episodes with the same seed, their differences, the verdict.

A pair is one episode of A and one of B that agree in all of `PAIR` and in the seed; a group is the pairs
that agree in `PAIR`. Nothing is pooled over groups.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from cosim.errors import BadInput
from cosim.evaluation import run_folder, wording
from cosim.evaluation.figures import Measure, Row
from cosim.evaluation.run_folder import Run
from cosim.evaluation.statistics import (
    NA,
    Figure,
    discordant,
    mcnemar,
    mean,
    paired_change,
    paired_mean,
    paired_share,
    share,
)
from cosim.evaluation.summary import GROUP, not_comparable
from cosim.evaluation.tasks import BAD_INPUT, OK
from cosim.evaluation.thresholds import CHANGE, DIFFERENCE, Threshold, parse
from cosim.sumocfg import hint

PAIR = tuple(name for name in GROUP if name != "policy")
ACROSS = ("behavior", "penetration", "preset", "svo_deg", "driver_model")  # what A and B may differ in
PASSED, FAILED, SKIPPED = "passed", "failed", "skipped"


@dataclass(frozen=True, slots=True)
class PairedFigure:
    """One measure of A and of B over the pairs in which it applies to both."""

    measure: Measure
    a: Figure
    b: Figure
    difference: Figure  # b - a
    n: int  # pairs it is from
    na: int  # pairs in which it is NA on either side
    na_on_both: int  # of these
    hits: tuple[int, int] | None = None  # episodes of A and of B in which it happened, of a rate
    p: float | None = None  # exact McNemar, of a rate

    def document(self) -> dict[str, Any]:
        """Plain JSON values."""
        found = {
            "a": self.a.document(),
            "b": self.b.document(),
            "difference": self.difference.document(),
            "n": self.n,
            "na": self.na,
            "unit": self.measure.unit,
            "better": self.measure.better,
        }
        if self.hits is not None:
            found |= {"hits_a": self.hits[0], "hits_b": self.hits[1], "p": self.p}
        return found


@dataclass(frozen=True, slots=True)
class Check:
    """One threshold in one group."""

    threshold: Threshold
    group: str
    status: str  # PASSED, FAILED or SKIPPED
    message: str  # with the figures


@dataclass(frozen=True)
class Compared:
    """One group of pairs with its figures."""

    group: Group
    known: dict[str, Measure]
    seed: int  # of the bootstrap

    @cached_property
    def figures(self) -> dict[str, PairedFigure]:
        """Every measure by name."""
        return {name: paired(measure, self.group.pairs, self.seed) for name, measure in self.known.items()}

    def check(self, threshold: Threshold) -> Check:
        """Hold one threshold against the group."""
        status, message = _judge(threshold, self)
        return Check(threshold, self.group.name, status, message)


@dataclass(frozen=True)
class Comparison:
    """Everything that `cosim compare` shows."""

    a: str
    b: str
    groups: list[Group]
    checks: list[Check]
    alone: tuple[list[str], list[str]]  # cells that only A, only B has

    @property
    def exit_code(self) -> int:
        """0 passed, 1 a threshold failed, 2 input refused, 3 simulations failed among the compared."""
        if any(group.refused for group in self.groups):
            return 2
        if any(group.failed for group in self.groups):
            return 3
        return int(any(check.status == FAILED for check in self.checks))

    @property
    def verdict(self) -> str:
        """The same in words."""
        refused = sum(len(group.refused) for group in self.groups)
        failed = sum(len(group.failed) for group in self.groups)
        if refused:
            return f"no verdict: {refused} compared episodes had bad input"
        if failed:
            return f"no verdict: {failed} of the compared simulations crashed or timed out"
        if not self.checks:
            return "compared, no threshold was given"
        bad = sum(check.status == FAILED for check in self.checks)
        if bad:
            return f"failed: {bad} of {len(self.checks)} checks"
        skipped = sum(check.status == SKIPPED for check in self.checks)
        passed = f"passed: {len(self.checks) - skipped} of {len(self.checks)} checks"
        return f"{passed}, {skipped} do not apply" if skipped else passed


def compare(
    a: Side, b: Side, fail_on: Sequence[str] = (), *, across: Sequence[str] = (), seed: int = 0
) -> Comparison:
    """Pair the episodes and hold every threshold against every group.

    `across`: names of `PAIR` in which A and B may differ, e.g. ("svo_deg",). `seed` fixes the bootstrap.

    Raises:
        BadInput: nothing to pair, no seed in common, a side's policy is not clear, a threshold that cannot
            be read or that applies to no group.
    """
    for name in across:
        if name not in ACROSS:
            raise BadInput(
                f"not one of {', '.join(ACROSS)}{hint(name, ACROSS)}", field="--across", value=name
            )
    known = {**b.run.measures, **a.run.measures}
    thresholds = [parse(text, known) for text in fail_on]
    groups, alone = _pair(a, b, tuple(across), known, seed)
    checks = [group.check(threshold) for group in groups for threshold in thresholds]
    for threshold in thresholds:
        mine = [check for check in checks if check.threshold is threshold]
        if all(check.status == SKIPPED for check in mine):
            problem = f"{threshold.measure.name} is NA in every compared episode"
            raise BadInput(problem, field="--fail-on", value=threshold.text)
    return Comparison(_title(a), _title(b), groups, checks, alone)


def paired(measure: Measure, pairs: Sequence[tuple[Row, Row]], seed: int = 0) -> PairedFigure:
    """One measure over the pairs; those in which it is NA on either side are left out, and counted."""
    before, after = (measure.values(rows) for rows in ([a for a, _ in pairs], [b for _, b in pairs]))
    both = [(x, y) for x, y in zip(before, after, strict=True) if not math.isnan(x) and not math.isnan(y)]
    neither = sum(math.isnan(x) and math.isnan(y) for x, y in zip(before, after, strict=True))
    n, na = len(both), len(pairs) - len(both)
    x, y = [x for x, _ in both], [y for _, y in both]
    if not measure.is_rate:
        difference = paired_mean(x, y, seed)
        return PairedFigure(measure, mean(x, seed), mean(y, seed), difference, n, na, neither)
    was, now = [v > 0 for v in x], [v > 0 for v in y]
    hits = (sum(was), sum(now))
    difference = paired_share(was, now) if n else NA
    p = mcnemar(*discordant(was, now)) if n else None
    return PairedFigure(measure, share(hits[0], n), share(hits[1], n), difference, n, na, neither, hits, p)


# ---- inside ----

def _judge(threshold: Threshold, group: Group) -> tuple[str, str]:
    """Status and message of one threshold in one group."""
    measure = threshold.measure
    found = group.figures[measure.name]
    if not group.pairs:
        return FAILED, "no pair of episodes finished on both sides"
    if found.na_on_both == len(group.pairs):
        return SKIPPED, f"{measure.name} is NA in all {len(group.pairs)} pairs"
    if threshold.kind == CHANGE:
        x, y = (measure.values([pair[k] for pair in group.pairs]) for k in (0, 1))
        figure = paired_change(x, y, group.seed)
        value, shown = threshold.of(figure), wording.change(threshold.of(figure))
    else:
        signed = threshold.kind == DIFFERENCE
        value = threshold.of(found.difference if signed else found.b)
        shown = wording.number(value, measure, signed=signed)
    what = measure.name if threshold.bound == "value" else f"{threshold.bound} bound of {measure.name}"
    if math.isnan(value) and found.n and threshold.bound != "value":
        shown = f"NA (no interval from {found.n} pair{'s' * (found.n > 1)})"
    message = f"{what} {'' if threshold.kind == 'absolute' else 'B - A '}is {shown}: {_figures(found)}"
    return (FAILED if threshold.fails(value) else PASSED), message


def _figures(found: PairedFigure) -> str:
    """`A 2.5 % (0.4 to 12.9), B ..., B - A ..., 40 pairs`, everything that a reader needs to judge."""
    m = found.measure
    count_a, count_b = (f" = {h}/{found.n}" for h in found.hits) if found.hits else ("", "")
    parts = [
        f"A {wording.interval(found.a, m)}{count_a}",
        f"B {wording.interval(found.b, m)}{count_b}",
        f"B - A {wording.interval(found.difference, m, signed=True)}",
        f"{found.n} pairs" + (f", {found.na} more are NA" if found.na else ""),
    ]
    if found.p is not None:
        parts.append(wording.p_value(found.p))
    return ", ".join(parts)


