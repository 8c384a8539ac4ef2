"""A against B on equal traffic: their figures, the differences of pairs, and the verdict on thresholds."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from cosim.errors import BadInput
from cosim.report import wording
from cosim.report.figures import Measure, Row
from cosim.report.pairing import MISSION_COLUMNS, Group, Side, pair, title
from cosim.report.statistics import (
    Figure,
    discordant,
    mcnemar,
    mean,
    paired_change,
    paired_mean,
    paired_rate,
    paired_rate_change,
    paired_share,
    pooled_rate,
    share,
)
from cosim.report.thresholds import CHANGE, DIFFERENCE, Threshold, parse

PASSED, FAILED, SKIPPED = "passed", "failed", "skipped"


@dataclass(frozen=True, slots=True)
class PairedFigure:
    """One measure of A and of B over the pairs with a value on both sides."""

    measure: Measure
    a: Figure
    b: Figure
    difference: Figure  # b - a
    n: int  # pairs with a value on both sides
    na: int  # pairs in which it is NA on either side
    na_on_both: int  # pairs in which it is NA on both sides
    hits: tuple[int, int] | None = None  # of a rate: episodes of A and of B with the event
    tallies: tuple[tuple[int, float], ...] = ()  # of an incidence: events and exposure of A, of B
    p: float | None = None  # of a rate: exact McNemar

    def document(self) -> dict[str, Any]:
        """Plain JSON values."""
        document = {
            "a": self.a.document(),
            "b": self.b.document(),
            "difference": self.difference.document(),
            "n": self.n,
            "na": self.na,
            "unit": self.measure.unit,
            "better": self.measure.better,
        }
        if self.hits is not None:
            document |= {"hits_a": self.hits[0], "hits_b": self.hits[1], "p": self.p}
        for side, (events, exposure) in zip("ab", self.tallies, strict=False):
            document |= {f"events_{side}": events, f"exposure_{side}": exposure}
        return document

    @property
    def counts(self) -> tuple[str, str]:
        """The counts behind A and B: `3/40` of a rate, `12 in 3.4 h` of an incidence, "" of a mean."""
        if self.tallies:
            a, b = (wording.events(*tally, self.measure.per) for tally in self.tallies)
            return a, b
        return (f"{self.hits[0]}/{self.n}", f"{self.hits[1]}/{self.n}") if self.hits else ("", "")


@dataclass(frozen=True, slots=True)
class Check:
    """One threshold in one group."""

    threshold: Threshold
    group: Group
    status: str  # PASSED, FAILED or SKIPPED
    finding: str  # the figure that decided, in words
    figures: str = ""  # A, B and the difference, for output without a table


class PairedFigures(Mapping[str, PairedFigure]):
    """Every measure of a group by name, each bootstrapped at its first access."""

    def __init__(self, known: Mapping[str, Measure], pairs: Sequence[tuple[Row, Row]], seed: int) -> None:
        self._known = known
        self._figure = cache(lambda name: paired(known[name], pairs, seed))

    def __getitem__(self, name: str) -> PairedFigure:
        return self._figure(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._known)

    def __len__(self) -> int:
        return len(self._known)


@dataclass(frozen=True)
class Compared:
    """One group of pairs with its figures."""

    group: Group
    figures: PairedFigures
    seed: int  # of the bootstrap


@dataclass(frozen=True)
class Comparison:
    """The result of `cosim compare`."""

    a: str
    b: str
    groups: list[Compared]
    checks: list[Check]
    unmatched: tuple[list[str], list[str]]  # cells of A only, of B only
    unfinished: tuple[str, ...] = ()  # a line for each unfinished run: `37 of 80 episodes of DIR are driven`
    partial: bool = False  # whether thresholds judge unfinished runs

    @property
    def undecided(self) -> bool:
        """Whether thresholds are given that only finished runs can pass or fail."""
        return bool(self.unfinished and self.checks) and not self.partial

    @property
    def exit_code(self) -> int:
        """0 passed, 1 a threshold failed, 2 input refused or unfinished, 3 simulations failed among the
        compared."""
        return self._outcome[0]

    @property
    def verdict(self) -> str:
        """The exit code in words."""
        return self._outcome[1]

    @property
    def _outcome(self) -> tuple[int, str]:
        if self.undecided:
            return 2, "no verdict: the batch is unfinished (--partial judges the episodes that there are)"
        if refused := sum(len(g.group.refused) for g in self.groups):
            return 2, f"no verdict: {refused} compared episodes had bad input"
        if failed := sum(len(g.group.failed) for g in self.groups):
            return 3, f"no verdict: {failed} of the compared simulations crashed or timed out"
        count = Counter(check.status for check in self.checks)
        if count[FAILED]:
            return 1, f"failed: {count[FAILED]} of {len(self.checks)} checks"
        passed = f"passed: {count[PASSED]} of {len(self.checks)} checks" if count else ""
        skipped = f", {count[SKIPPED]} do not apply" if count[SKIPPED] else ""
        extent = ", on a part of the episodes" if count and self.unfinished else ""
        return 0, passed + skipped + extent or "compared, no threshold was given"


def compare(
    a: Side,
    b: Side,
    fail_on: Sequence[str] = (),
    *,
    across: Sequence[str] = (),
    partial: bool = False,
    seed: int = 0,
) -> Comparison:
    """Pair the episodes and test every threshold in every group.

    Args:
        a: the baseline.
        b: the candidate.
        fail_on: thresholds (`cosim.report.thresholds`).
        across: options in which A and B may differ, e.g. ("svo_deg",).
        partial: whether thresholds judge unfinished runs by their finished episodes.
        seed: fixes the bootstrap.

    Raises:
        BadInput: as `pair`; a threshold that is malformed, applies to no group, or is on a figure of a
            guessed mission vehicle.
    """
    known = {**b.run.measures, **a.run.measures}
    thresholds = [parse(text, known) for text in fail_on]
    paired_groups, unmatched = pair(a, b, across)
    guessed = sum(group.mission_guessed for group in paired_groups)
    for threshold in thresholds:
        if guessed and threshold.measure.column in MISSION_COLUMNS:
            problem = (
                f"the mission vehicle of {guessed} pairs was guessed, and a guess feeds no gate: drive both "
                "with --mission ID, or leave this threshold out"
            )
            raise BadInput(problem, field="--fail-on", value=threshold.text)
    groups = [Compared(group, PairedFigures(known, group.pairs, seed), seed) for group in paired_groups]
    checks = [Check(t, compared.group, *_judge(t, compared)) for compared in groups for t in thresholds]
    for threshold in thresholds:
        if all(check.status == SKIPPED for check in checks if check.threshold is threshold):
            problem = f"{threshold.measure.name} is NA in every compared episode"
            raise BadInput(problem, field="--fail-on", value=threshold.text)
    runs = [side.run for side in (a, b) if side.run.missing]
    unfinished = dict.fromkeys(f"{len(r.rows)} of {r.planned} episodes of {r.path} are driven" for r in runs)
    return Comparison(title(a), title(b), groups, checks, unmatched, tuple(unfinished), partial)


def paired(measure: Measure, pairs: Sequence[tuple[Row, Row]], seed: int = 0) -> PairedFigure:
    """One measure over the pairs; pairs in which it is NA on either side are left out, and counted."""
    values = np.array([measure.values([pair[k] for pair in pairs]) for k in (0, 1)])  # [2,pairs]
    missing = np.isnan(values)
    x, y = values[:, ~missing.any(0)]
    n, na, na_on_both = len(x), len(pairs) - len(x), int(missing.all(0).sum())
    if measure.per:
        before, after = (measure.tally([pair[k] for pair in pairs])[:, ~missing.any(0)] for k in (0, 1))
        rates = pooled_rate(*before), pooled_rate(*after), paired_rate(before, after)
        tallies = tuple((int(k.sum()), measure.scale * float(t.sum())) for k, t, _ in (before, after))
        return PairedFigure(measure, *rates, n, na, na_on_both, tallies=tallies)
    if not measure.is_rate:
        difference = paired_mean(x, y, seed)
        return PairedFigure(measure, mean(x, seed), mean(y, seed), difference, n, na, na_on_both)
    in_a, in_b = x > 0, y > 0
    hits = (int(in_a.sum()), int(in_b.sum()))
    shares = share(hits[0], n), share(hits[1], n), paired_share(in_a, in_b)
    p = mcnemar(*discordant(in_a, in_b)) if n else None
    return PairedFigure(measure, *shares, n, na, na_on_both, hits, p=p)


# ---- inside ----


def _judge(threshold: Threshold, compared: Compared) -> tuple[str, str, str]:
    """Status, finding and figures of one threshold in one group."""
    measure, pairs = threshold.measure, compared.group.pairs
    in_pairs = compared.figures[measure.name]
    if not pairs:
        return FAILED, "no pair of episodes finished on both sides", ""
    if in_pairs.na_on_both == len(pairs):
        return SKIPPED, f"{measure.name} is NA in all {len(pairs)} pairs", ""
    rows = [[both[k] for both in pairs] for k in (0, 1)]
    count = f"{in_pairs.n} pairs" + (f", NA in {in_pairs.na} more" if in_pairs.na else "")
    if threshold.kind == CHANGE:
        figure, what = _change(measure, rows, compared.seed), "B / A - 1"
        judged, value, low, high = map(
            wording.change, (threshold.of(figure), figure.value, figure.low, figure.high)
        )
        shown = f"{value} ({low} to {high})"
    elif threshold.kind == DIFFERENCE:
        figure, what = in_pairs.difference, "B - A"
        judged = wording.number(threshold.of(figure), measure, signed=True)
        shown = wording.interval(figure, measure, signed=True)
    else:  # the figure of B includes pairs in which only A is NA
        figure, count = _of_candidate(measure, rows[1], compared.seed)
        what = "B"
        judged = wording.number(threshold.of(figure), measure)
        shown = wording.interval(figure, measure)
    finding = f"{what} is {shown}, {count}"
    if threshold.bound != "value":
        finding = f"{threshold.bound} bound is {judged}: {finding}"
    return FAILED if threshold.fails(threshold.of(figure)) else PASSED, finding, _in_words(in_pairs)


def _change(measure: Measure, rows: Sequence[Sequence[Row]], seed: int) -> Figure:
    """B / A - 1 over the pairs in which A and B are known."""
    if not measure.per:
        return paired_change(measure.values(rows[0]), measure.values(rows[1]), seed)
    before, after = (measure.tally(of_side) for of_side in rows)
    known = ~np.isnan([*before, *after]).any(0)
    return paired_rate_change(before[:, known], after[:, known])


def _of_candidate(measure: Measure, rows: Sequence[Row], seed: int) -> tuple[Figure, str]:
    """The figure of B over the episodes of all pairs, and its counts in words."""
    y = [value for value in measure.values(rows) if not math.isnan(value)]
    if measure.per:
        tally = measure.tally(rows)
        events, exposure, weight = tally[:, ~np.isnan(tally).any(0)]
        count = wording.events(int(events.sum()), measure.scale * float(exposure.sum()), measure.per)
        return pooled_rate(events, exposure, weight), f"{count} of {len(y)} episodes"
    if measure.is_rate:
        return share(int(sum(y)), len(y)), f"{int(sum(y))} of {len(y)} episodes"
    return mean(y, seed), f"{len(y)} episodes"


def _in_words(figure: PairedFigure) -> str:
    """`A 2.5 % (0.4 to 12.9) = 1/40, B ..., B - A ..., p 1`"""
    m = figure.measure
    counts = [f" = {count}" if count else "" for count in figure.counts]
    parts = [
        f"A {wording.interval(figure.a, m)}{counts[0]}",
        f"B {wording.interval(figure.b, m)}{counts[1]}",
        f"B - A {wording.interval(figure.difference, m, signed=True)}",
    ]
    return ", ".join(parts if figure.p is None else [*parts, wording.p_value(figure.p)])
