"""What the decision layer must reach, and in words whether it does: every target against its figure.

A target asks for a value; the interval says how sure that is. So there are four answers: met, met but the
interval reaches beyond, missed but the interval still holds the target, missed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, NamedTuple

from benchmarks.arms import differences, of_world
from benchmarks.tables import found
from benchmarks.worlds import WITH_MISSION
from cosim.report import wording
from cosim.report.compare import Compared, PairedFigure
from cosim.report.figures import RATES
from cosim.report.run_folder import Run
from cosim.report.statistics import Figure, paired_change

Sense = Literal["at least", "at most"]

CRASHES = {"merge": 0.01, "exit": 0.01, "highway": 0.01, "roundabout": 0.03, "intersection": 0.03}
LET_IN, IDM_LET_IN, ABOVE_TWIN = 0.90, 0.10, 0.40  # merge, contested
ABOVE_IDM = 0.40  # exit, roundabout, intersection
FARTHER = 1.5  # times as far as with idm, the mission vehicle
SIGNIFICANT = 0.05  # of the exact test


class Arms(NamedTuple):
    """Who plays which part."""

    agent: str
    twin: str
    idm: str = "idm"
    rule: str = "altruist-rule"


class Finding(NamedTuple):
    """One target in one world."""

    demand: str
    world: str
    target: str
    found: str
    verdict: str

    @property
    def met(self) -> bool:
        """By the value at least."""
        return self.verdict.startswith("met")


def judged(figure: Figure, sense: Sense, limit: float) -> str:
    """The verdict in words."""
    if not figure.known:
        return "**not measured**"
    sign = 1.0 if sense == "at least" else -1.0
    slack = 1e-9  # 3 of 300 is at most 1 %, whatever float arithmetic makes of it
    value, *ends = (sign * (x - limit) for x in (figure.value, figure.low, figure.high))
    if any(math.isnan(end) for end in ends):
        ends = [value, value]
    if value >= -slack:
        return "met" if min(ends) >= -slack else "met; the interval reaches beyond the target"
    return "**missed**; the interval still holds the target" if max(ends) >= -slack else "**missed**"


def significant(pair: PairedFigure) -> str:
    """Whether a difference is above 0 beyond chance: interval and, of rates, exact test agree."""
    if not pair.difference.known:
        return "**not measured**"
    sure = pair.difference.low > 0.0 and (pair.p is None or pair.p < SIGNIFICANT)
    if sure:
        return "met"
    return "**missed**: not beyond chance" if pair.difference.value > 0.0 else "**missed**"


def headline(pair: PairedFigure) -> str:
    """T's claim in one figure: shown, not shown, or shown the other way round."""
    d, better = pair.difference, 1.0 if pair.measure.better == "higher" else -1.0
    if not d.known:
        return "not measured"
    low, high = sorted((better * d.low, better * d.high))
    chance = pair.p is not None and pair.p >= SIGNIFICANT
    if low > 0.0 and not chance:
        return "shown"
    return "the other way round" if high < 0.0 and not chance else "not shown"


def dense(runs: Mapping[str, Run], worlds: Sequence[str], arms: Arms) -> Iterator[Finding]:
    """Target 1: few crashes, and no distance lost by them or by caution."""
    to_idm = differences(runs[arms.idm], runs[arms.agent])
    for world in worlds:
        yield crashes(runs[arms.agent], world)
        distance = to_idm[world].figures["dt_mean_m"]
        yield Finding(
            *("dense", world, "DT of all vehicles no lower than idm's", _signed(distance)),
            judged(distance.difference, "at least", 0.0),
        )


def crashes(run: Run, world: str) -> Finding:
    """C% of the agent."""
    measure, limit = RATES["collision_rate"], CRASHES[world]
    figure, counts = found(of_world(run, world), measure)
    text = f"{wording.interval(figure, measure)}, {counts['hits']}/{counts['n']}"
    target = f"crashes in at most {100 * limit:g} %"
    return Finding("dense", world, target, text, judged(figure, "at most", limit))


def contested(runs: Mapping[str, Run], worlds: Sequence[str], arms: Arms) -> Iterator[Finding]:
    """Target 2: the mission vehicle is served, and served because somebody yields."""
    to_idm, to_twin, to_rule = (
        differences(runs[other], runs[arms.agent]) for other in (arms.idm, arms.twin, arms.rule)
    )
    for world in worlds:
        if world not in WITH_MISSION:
            continue

        def line(target: str, text: str, verdict: str, world: str = world) -> Finding:
            return Finding("contested", world, target, text, verdict)

        success = "mission_success_rate"
        over_idm, over_twin = to_idm[world].figures[success], to_twin[world].figures[success]
        if world == "merge":
            text, verdict = _own(over_idm.b, over_idm), judged(over_idm.b, "at least", LET_IN)
            yield line(f"lets at least {100 * LET_IN:g} % in", text, verdict)
            text, verdict = _own(over_idm.a, over_idm), judged(over_idm.a, "at most", IDM_LET_IN)
            yield line(f"`idm` at most {100 * IDM_LET_IN:g} %", text, verdict)
            verdict = judged(over_twin.difference, "at least", ABOVE_TWIN)
            target = f"the egoistic twin at least {100 * ABOVE_TWIN:g} points less"
            yield line(target, _signed(over_twin), verdict)
        else:
            verdict = judged(over_idm.difference, "at least", ABOVE_IDM)
            yield line(f"at least {100 * ABOVE_IDM:g} points above `idm`", _signed(over_idm), verdict)
            yield line("significantly above the twin", _signed(over_twin), significant(over_twin))
        ratio = farther(to_idm[world])
        yield line(
            f"the mission vehicle travels at least {FARTHER:g} times as far as with `idm`",
            ratio.text(2),
            judged(ratio, "at least", FARTHER),
        )
        over_rule = to_rule[world].figures
        for name, target, sense in (
            (success, "serves at least as many as `altruist-rule`", "at least"),
            ("hard_brakings_av", "with fewer hard brakings", "at most"),
            ("dt_av_m", "and no larger loss of distance for the AVs", "at least"),
        ):
            difference = over_rule[name].difference
            verdict = judged(difference, "at least" if sense == "at least" else "at most", 0.0)
            if name == "hard_brakings_av" and difference.value == 0.0:
                verdict = "**missed**: as many"
            yield line(target, _signed(over_rule[name]), verdict)


def farther(pairs: Compared) -> Figure:
    """How many times as far the mission vehicle travels: ratio of the means, over pairs."""
    measure = pairs.figures["dt_mission_m"].measure
    before, after = (measure.values([pair[k] for pair in pairs.group.pairs]) for k in (0, 1))
    change = paired_change(before, after, pairs.seed)
    return Figure(1.0 + change.value, 1.0 + change.low, 1.0 + change.high)


def altruists_against_twin(demand: str, before: Run, after: Run, worlds: Sequence[str]) -> Iterator[Finding]:
    """Target 3, T's headline: altruists crash less and everybody gets further."""
    pairs = differences(before, after)
    for world in worlds:
        for name, target in (
            ("collision_rate", "altruists crash less"),
            ("dt_mean_m", "the distance of all vehicles is higher"),
        ):
            pair = pairs[world].figures[name]
            yield Finding(demand, world, target, _signed(pair), headline(pair))


# ---- inside ----


def _signed(pair: PairedFigure) -> str:
    text = wording.interval(pair.difference, pair.measure, signed=True)
    return text if pair.p is None else f"{text}, {wording.p_value(pair.p)}"


def _own(figure: Figure, pair: PairedFigure) -> str:
    return f"{wording.interval(figure, pair.measure)}, {pair.n} episodes"
