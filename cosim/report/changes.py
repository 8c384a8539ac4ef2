"""What differences on equal seeds say of the figures that a verdict names: better, worse, or chance."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from cosim.report import wording
from cosim.report.compare import PairedFigure
from cosim.report.statistics import CONFIDENCE

GOOD, BAD = "good", "bad"
IN_WORDS = {
    "collision_rate": "collisions",
    "av_caused_collision_rate": "AV-caused collisions",
    "mission_success_rate": "mission success",
    "dt_mission_m": "the mission vehicle's distance",
    "dt_av_m": "the AVs' distance",
    "total_delay_s": "everybody's delay",
    "total_delay_av_s": "the AVs' delay",
    "total_delay_hv_s": "the humans' delay",
    "total_delay_slowest_tenth_s": "the slowest tenth's delay",
    "arrivals": "arrivals",
    "longest_wait_s": "the longest wait",
    "mean_squared_wait_s2": "the mean squared wait",
    "co2_kg_per_vehicle_km": "CO2 per km",
}


@dataclass(frozen=True, slots=True)
class Changes:
    """Of B against A, in words: what got better and worse, with interval, and what shows no difference."""

    better: list[str]
    worse: list[str]
    alike: list[str]

    @property
    def lines(self) -> list[str]:
        """`better: ...`, `worse: ...`, `no difference shown: ...`; those that say something."""
        said = {"better": self.better, "worse": self.worse, "no difference shown": self.alike}
        return [f"{name}: {', '.join(found)}" for name, found in said.items() if found]


def changes(figures: Mapping[str, PairedFigure]) -> Changes:
    """Those of `IN_WORDS` that apply; one pair cannot show that there is no difference."""
    found: dict[str, list[str]] = {GOOD: [], BAD: [], "": []}
    for name, words in IN_WORDS.items():
        if name in figures and (figure := figures[name]).n:
            how = tone(figure)
            value = wording.interval(figure.difference, figure.measure, signed=True, n=figure.n)
            if how or figure.n >= wording.SEVERAL:
                found[how].append(f"{words} {value}" if how else words)
    return Changes(found[GOOD], found[BAD], found[""])


def tone(figure: PairedFigure) -> str:
    """Whether a difference is good or bad news; "" where chance may have made it.

    That is where its interval holds 0, or, of a rate, McNemar's exact p is 5 % or more: with a handful of
    crashes Tango's interval can leave 0 out where the exact test does not agree.
    """
    d = figure.difference
    chance = math.isnan(d.low) or d.low <= 0.0 <= d.high
    if chance or (figure.p is not None and figure.p >= 1.0 - CONFIDENCE) or not figure.measure.better:
        return ""
    return GOOD if (d.value > 0.0) == (figure.measure.better == "higher") else BAD
