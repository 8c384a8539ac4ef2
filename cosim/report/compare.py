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
from cosim.report.pairing import Group, Side, pair, title
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

OF_THE_MISSION = frozenset({"mission_success", "mission_failed_at_end", "mission_time_s", "dt_mission_m"})
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
    tallies: tuple[tuple[int, float], ...] = ()  # of A and of B: events and exposure, of an incidence
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
        for side, (events, exposure) in zip("ab", self.tallies, strict=False):
            found |= {f"events_{side}": events, f"exposure_{side}": exposure}
        return found

    @property
    def counts(self) -> tuple[str, str]:
        """What stands beside A and B: `3/40`, `12 in 3.4 h`, or nothing."""
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
    finding: str  # what the threshold was held against
    figures: str = ""  # A, B and the difference, for who sees no table beside it


class PairedFigures(Mapping[str, PairedFigure]):
    """Every measure of a group by name, each bootstrapped when it is first asked for."""

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
    """Everything that `cosim compare` shows."""

    a: str
    b: str
    groups: list[Compared]
    checks: list[Check]
    alone: tuple[list[str], list[str]]  # cells that only A, only B has
    unfinished: tuple[str, ...] = ()  # `37 of 80 episodes of DIR are driven`, of each run that lacks some
    partial: bool = False  # thresholds are held against an unfinished run all the same

    @property
    def open(self) -> bool:
        """Whether thresholds are given that only finished runs can pass or fail."""
        return bool(self.unfinished and self.checks) and not self.partial

    @property
    def exit_code(self) -> int:
        """0 passed, 1 a threshold failed, 2 input refused or unfinished, 3 simulations failed among the
        compared."""
        return self._judged[0]

    @property
    def verdict(self) -> str:
        """The same in words."""
        return self._judged[1]

    @property
    def _judged(self) -> tuple[int, str]:
        if self.open:
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
        part = ", on a part of the episodes" if count and self.unfinished else ""
        return 0, passed + skipped + part or "compared, no threshold was given"


def compare(
    a: Side,
    b: Side,
    fail_on: Sequence[str] = (),
    *,
    across: Sequence[str] = (),
    partial: bool = False,
    seed: int = 0,
) -> Comparison:
    """Pair the episodes and hold every threshold against every group.

    `across`: what A and B may differ in, e.g. ("svo_deg",). `partial`: thresholds judge unfinished runs by
    what there is of them. `seed` fixes the bootstrap.

    Raises:
        BadInput: see `pair`; a threshold that cannot be read, that applies to no group, or that is on a
            figure of a guessed mission vehicle.
    """
    known = {**b.run.measures, **a.run.measures}
    thresholds = [parse(text, known) for text in fail_on]
    found, alone = pair(a, b, across)
    guessed = sum(group.mission_guessed for group in found)
    for threshold in thresholds:
        if guessed and threshold.measure.column in OF_THE_MISSION:
            problem = (
                f"the mission vehicle of {guessed} pairs was guessed, and a guess feeds no gate: drive both "
                "with --mission ID, or leave this threshold out"
            )
            raise BadInput(problem, field="--fail-on", value=threshold.text)
    groups = [Compared(group, PairedFigures(known, group.pairs, seed), seed) for group in found]
    checks = [Check(t, compared.group, *_judge(t, compared)) for compared in groups for t in thresholds]
    for threshold in thresholds:
        if all(check.status == SKIPPED for check in checks if check.threshold is threshold):
            problem = f"{threshold.measure.name} is NA in every compared episode"
            raise BadInput(problem, field="--fail-on", value=threshold.text)
    runs = [one.run for one in (a, b) if one.run.missing]
    unfinished = dict.fromkeys(f"{len(r.rows)} of {r.planned} episodes of {r.path} are driven" for r in runs)
    return Comparison(title(a), title(b), groups, checks, alone, tuple(unfinished), partial)


def paired(measure: Measure, pairs: Sequence[tuple[Row, Row]], seed: int = 0) -> PairedFigure:
    """One measure over the pairs; those in which it is NA on either side are left out, and counted."""
    values = np.array([measure.values([pair[k] for pair in pairs]) for k in (0, 1)])  # [2,pairs]
    missing = np.isnan(values)
    x, y = values[:, ~missing.any(0)]
    n, na, neither = len(x), len(pairs) - len(x), int(missing.all(0).sum())
    if measure.per:
        before, after = (measure.tally([pair[k] for pair in pairs])[:, ~missing.any(0)] for k in (0, 1))
        rates = pooled_rate(*before), pooled_rate(*after), paired_rate(before, after)
        tallies = tuple((int(k.sum()), measure.scale * float(t.sum())) for k, t, _ in (before, after))
        return PairedFigure(measure, *rates, n, na, neither, tallies=tallies)
    if not measure.is_rate:
        difference = paired_mean(x, y, seed)
        return PairedFigure(measure, mean(x, seed), mean(y, seed), difference, n, na, neither)
    was, now = x > 0, y > 0
    hits = (int(was.sum()), int(now.sum()))
    difference = paired_share(was, now)
    p = mcnemar(*discordant(was, now)) if n else None
    return PairedFigure(measure, share(hits[0], n), share(hits[1], n), difference, n, na, neither, hits, p=p)


# ---- inside ----


def _judge(threshold: Threshold, compared: Compared) -> tuple[str, str, str]:
    """Status, finding and figures of one threshold in one group."""
    measure, pairs = threshold.measure, compared.group.pairs
    found = compared.figures[measure.name]
    if not pairs:
        return FAILED, "no pair of episodes finished on both sides", ""
    if found.na_on_both == len(pairs):
        return SKIPPED, f"{measure.name} is NA in all {len(pairs)} pairs", ""
    rows = [[both[k] for both in pairs] for k in (0, 1)]
    count = f"{found.n} pairs" + (f", NA in {found.na} more" if found.na else "")
    if threshold.kind == CHANGE:
        figure, what = _change(measure, rows, compared.seed), "B / A - 1"
        shown = [wording.change(v) for v in (threshold.of(figure), figure.value, figure.low, figure.high)]
        whole = f"{shown[1]} ({shown[2]} to {shown[3]})"
    elif threshold.kind == DIFFERENCE:
        figure, what = found.difference, "B - A"
        shown = [wording.number(threshold.of(figure), measure, signed=True)]
        whole = wording.interval(figure, measure, signed=True)
    else:  # of B alone: pairs in which only A is NA count too
        figure, count = _alone(measure, rows[1], compared.seed)
        what = "B"
        shown = [wording.number(threshold.of(figure), measure)]
        whole = wording.interval(figure, measure)
    finding = f"{what} is {whole}, {count}"
    if threshold.bound != "value":
        finding = f"{threshold.bound} bound is {shown[0]}: {finding}"
    return FAILED if threshold.fails(threshold.of(figure)) else PASSED, finding, _figures(found)


def _change(measure: Measure, rows: Sequence[Sequence[Row]], seed: int) -> Figure:
    """B / A - 1 over the pairs in which both are known."""
    if not measure.per:
        return paired_change(measure.values(rows[0]), measure.values(rows[1]), seed)
    before, after = (measure.tally(mine) for mine in rows)
    known = ~np.isnan([*before, *after]).any(0)
    return paired_rate_change(before[:, known], after[:, known])


def _alone(measure: Measure, rows: Sequence[Row], seed: int) -> tuple[Figure, str]:
    """The figure of one side over all its episodes, and what it is from."""
    y = [value for value in measure.values(rows) if not math.isnan(value)]
    if measure.per:
        tally = measure.tally(rows)
        events, exposure, weight = tally[:, ~np.isnan(tally).any(0)]
        said = wording.events(int(events.sum()), measure.scale * float(exposure.sum()), measure.per)
        return pooled_rate(events, exposure, weight), f"{said} of {len(y)} episodes"
    if measure.is_rate:
        return share(int(sum(y)), len(y)), f"{int(sum(y))} of {len(y)} episodes"
    return mean(y, seed), f"{len(y)} episodes"


def _figures(found: PairedFigure) -> str:
    """`A 2.5 % (0.4 to 12.9) = 1/40, B ..., B - A ..., p 1`"""
    m = found.measure
    counts = [f" = {count}" if count else "" for count in found.counts]
    parts = [
        f"A {wording.interval(found.a, m)}{counts[0]}",
        f"B {wording.interval(found.b, m)}{counts[1]}",
        f"B - A {wording.interval(found.difference, m, signed=True)}",
    ]
    return ", ".join(parts if found.p is None else [*parts, wording.p_value(found.p)])
