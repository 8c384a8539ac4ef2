"""The evaluation of a claim: figures with intervals, tests of pairs, and one verdict.

The statistics are those of `cosim compare`. Tests are corrected together, by Holm's method.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from cosim.errors import BadInput, hint
from cosim.report.compare import PairedFigure, paired
from cosim.report.figures import Measure, Row, measures
from cosim.report.statistics import (
    NA,
    Figure,
    grouped_mean,
    holm,
    mean,
    paired_share,
    power,
    share,
    signed_rank,
    widened,
)
from cosim.types import Floats
from cosim.workers.tasks import OK
from research.drive import PART, Arm, Arms, policy, pooled
from research.schema import Claim, Condition

SIGNIFICANT = 0.05  # level for p, which is corrected for all tests of the claim
Verdict = Literal["yes", "no", "unresolved"]


class Line(NamedTuple):
    """One figure, a line of the CSV. Shares and their differences are fractions."""

    scenario: str
    condition: str  # values of the matrix
    arm: str
    against: str  # the arm it is a paired difference to; "" for a figure of its own
    figure: str
    unit: str
    value: float
    low: float
    high: float
    n: int  # episodes, or pairs
    na: int
    p: float | None = None  # of the claim's test, and corrected for all of them
    p_holm: float | None = None
    preset: str = ""
    errors: str = ""
    sensing: str = ""
    drivers: str = ""
    policy: str = ""
    weights: str = ""
    definitions: str = ""


class Traffic(NamedTuple):
    """The traffic of a row of a page."""

    preset: str
    errors: str  # of the human drivers
    sensing: str  # of the AVs
    drivers: str  # the human drivers' behavior


@dataclass(frozen=True)
class Tested:
    """The claim in one condition, against one arm."""

    condition: Condition
    against: str
    found: PairedFigure  # difference: the claim's arm minus `against`
    p: float
    p_holm: float
    power: float  # to find the smallest effect of interest
    verdict: Verdict


@dataclass(frozen=True)
class Found:
    """The complete evaluation of a claim."""

    claim: Claim
    arms: Arms
    measures: Mapping[str, Measure]
    tested: tuple[Tested, ...]

    @property
    def verdict(self) -> Verdict:
        """The verdict over all comparisons; `Claim.holds` says in how many the claim must hold."""
        verdicts = {one.verdict for one in self.tested}
        decisive: Verdict = "no" if self.claim.holds == "everywhere" else "yes"
        other: Verdict = "yes" if decisive == "no" else "no"
        if decisive in verdicts:
            return decisive
        return other if verdicts == {other} else "unresolved"

    @property
    def overall(self) -> dict[str, PairedFigure]:
        """Against each arm: the primary figure over the pairs of all conditions.

        Conditions of one scenario have the same traffic, so the interval resamples traffic, not pairs.
        """
        claim, primary = self.claim, self.measures[self.claim.primary.metric]
        conditions = list(dict.fromkeys(condition for condition, _ in self.arms))
        found = {}
        for against in claim.compare.against:
            of = {c: pairs(self.arms[c, against], self.arms[c, claim.compare.arm]) for c in conditions}
            both = [pair for one in of.values() for pair in one]
            traffic = [(c.scenario, _traffic(row)) for c, one in of.items() for row, _ in one]
            found[against] = paired(primary, both)
            if not primary.per and len({*traffic}) < len(traffic):
                before, after = _sides(primary, both)
                difference = grouped_mean(after - before, traffic)
                found[against] = replace(found[against], difference=difference)
        return found

    def figure(self, condition: Condition, arm: str, metric: str) -> Figure:
        """One arm's figure in one condition; NA where it applies to no episode."""
        return figure(self.measures[metric], self.arms[condition, arm].rows)

    def difference(self, condition: Condition, against: str, metric: str) -> PairedFigure:
        """The claim's arm minus another arm, on equal seeds."""
        both = (self.arms[condition, arm] for arm in (against, self.claim.compare.arm))
        return paired(self.measures[metric], pairs(*both))

    def lines(self) -> Iterator[Line]:
        """Every figure of every arm, then every difference."""
        for (condition, name), arm in self.arms.items():
            for metric in self.claim.metrics:
                measure = self.measures[metric]
                n = len(_known(measure, arm.rows))
                counts = (n, len(_ok(arm.rows)) - n)
                yield _line(
                    condition, arm, (name, "", metric, measure.unit), figure(measure, arm.rows), counts
                )
        for one in self.tested:
            arm = self.arms[one.condition, self.claim.compare.arm]
            for metric in self.claim.metrics:
                found = self.difference(one.condition, one.against, metric)
                what = (self.claim.compare.arm, one.against, metric, found.measure.unit)
                line = _line(one.condition, arm, what, found.difference, (found.n, found.na))
                tested = metric == self.claim.primary.metric
                yield line._replace(p=one.p, p_holm=one.p_holm) if tested else line


def evaluate(claim: Claim, arms: Arms, notes: Mapping[str, Mapping[str, str]]) -> Found:
    """Test the claim on these episodes, of every arm in each of the claim's conditions.

    Raises BadInput: a metric that the episodes do not have, or a test that does not fit the primary metric.
    """
    arms = pooled(claim, arms)
    rows = [row for arm in arms.values() for row in arm.rows]
    known = measures(rows, notes.get("units"), notes.get("better"))
    for metric in claim.metrics:
        if metric not in known:
            raise BadInput(
                f"no such figure{hint(metric, known)}", file=claim.name, field="metric", value=metric
            )
    primary = known[claim.primary.metric]
    if (claim.test == "mcnemar") != primary.is_rate:
        problem = f"{primary.name} is {'a' if primary.is_rate else 'not a'} share of episodes"
        raise BadInput(problem, file=claim.name, field="test", value=claim.test)
    conditions = dict.fromkeys(condition for condition, _ in arms)
    compared = [
        (condition, against, pairs(arms[condition, against], arms[condition, claim.compare.arm]))
        for condition in conditions
        for against in claim.compare.against
    ]
    found = [paired(primary, both) for _, _, both in compared]
    each = [_p(claim, primary, one, both) for one, (_, _, both) in zip(found, compared, strict=True)]
    together = holm(each)
    tested = [
        Tested(
            *(condition, against, one, p, corrected),
            power(claim.power.smallest, one.difference, len(found)),
            _verdict(claim, one, _most(claim, one, both, len(found)), corrected),
        )
        for (condition, against, both), one, p, corrected in zip(compared, found, each, together, strict=True)
    ]
    return Found(claim, arms, known, tuple(tested))


def pairs(before: Arm, after: Arm) -> list[tuple[Row, Row]]:
    """The episodes of both arms in equal traffic, if both completed."""
    first = {_traffic(row): row for row in _ok(before.rows)}
    return [(first[_traffic(row)], row) for row in _ok(after.rows) if _traffic(row) in first]


def figure(measure: Measure, rows: Sequence[Row]) -> Figure:
    """A measure over the completed episodes."""
    if measure.per:
        return measure.figure(_ok(rows))
    values = _known(measure, rows)
    if not values:
        return NA
    return share(int(sum(values)), len(values)) if measure.is_rate else mean(values)


def traffic_of(arm: Arm) -> Traffic:
    """The traffic of an arm's episodes."""
    row = arm.rows[0]
    errors, sensing = row.get("errors") or "none", row.get("sensing") or "ideal"
    return Traffic(str(row["preset"]), str(errors), str(sensing), str(row["behavior"]))


# ---- inside ----


def _line(
    condition: Condition, arm: Arm, what: tuple[str, str, str, str], shown: Figure, counts: tuple[int, int]
) -> Line:
    """A figure of `arm`, or its difference from another arm. `what`: arm, against, figure and unit."""
    return Line(
        *(condition.scenario, condition.text, *what),
        *(shown.value, shown.low, shown.high, *counts),
        **traffic_of(arm)._asdict(),
        policy=policy(arm.cell),
        weights=arm.weights,
        definitions=arm.definitions,
    )


def _ok(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if row["status"] == OK]


def _traffic(row: Row) -> tuple[int, int]:
    return row.get(PART, 0), row["seed"]


def _known(measure: Measure, rows: Sequence[Row]) -> list[float]:
    return [value for value in measure.values(_ok(rows)) if not math.isnan(value)]


def _p(claim: Claim, measure: Measure, found: PairedFigure, both: Sequence[tuple[Row, Row]]) -> float:
    if claim.test == "mcnemar":
        return 1.0 if found.p is None else found.p
    return signed_rank(*_sides(measure, both))


def _sides(measure: Measure, both: Sequence[tuple[Row, Row]]) -> Floats:
    """[2,pairs] the values before and after; nan: NA."""
    return np.array([measure.values([pair[k] for pair in both]) for k in (0, 1)])


def _most(claim: Claim, one: PairedFigure, both: Sequence[tuple[Row, Row]], tests: int) -> float:
    """The largest effect in the claimed direction that is not excluded.

    Its interval is wider than 95 %: by Bonferroni's correction for `tests` comparisons.
    """
    sign, wide = claim.primary.sign, one.difference
    if one.measure.is_rate:
        values = _sides(one.measure, both)
        before, after = values[:, ~np.isnan(values).any(0)] > 0.0
        wide = paired_share(before, after, tests)
        return max(sign * wide.low, sign * wide.high)
    most = max(sign * wide.low, sign * wide.high)
    return most + (widened(tests) - 1.0) * (most - sign * wide.value)


def _verdict(claim: Claim, one: PairedFigure, most: float, p: float) -> Verdict:
    """Yes: a significant difference in the claimed direction, whose interval excludes 0 too (the test of
    ranks is not about the mean). No: `power.smallest` is excluded.

    Where the other arm's share leaves no room for such an effect, only an effect the other way says no.
    """
    difference, sign = one.difference, claim.primary.sign
    if not difference.known:
        return "unresolved"
    if p < SIGNIFICANT and min(sign * difference.low, sign * difference.high) > 0.0:
        return "yes"
    room = math.inf
    if one.measure.is_rate:
        room = 1.0 - one.a.value if sign > 0.0 else one.a.value
    possible = claim.power.smallest <= room or most < 0.0
    return "no" if most < claim.power.smallest and possible else "unresolved"
