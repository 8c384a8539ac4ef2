"""Figures of B against A on equal seeds: better, worse, or without a difference."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from cosim.report import wording
from cosim.report.compare import PairedFigure
from cosim.report.statistics import CONFIDENCE

GOOD, BAD = "good", "bad"
FEWEST = 6  # pairs for an answer: with five of equal sign the exact sign test has p 0.06
# The measures that are judged, in words.
MEASURES = {
    "collision_rate": "collisions",
    "av_caused_collision_rate": "AV-caused collisions",
    "av_near_misses_ttc_per_av_hour": "the AVs' near-misses (TTC)",
    "hard_brakings_av": "the AVs' hard brakings",
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
    """Figures of B against A, in words: the better and worse ones with their intervals, and the others."""

    better: list[str]
    worse: list[str]
    alike: list[str]  # no difference is shown

    @property
    def lines(self) -> list[str]:
        """`better: ...`, `worse: ...`, `no difference shown: ...`; only lines that are not empty."""
        kinds = {"better": self.better, "worse": self.worse, "no difference shown": self.alike}
        return [f"{name}: {', '.join(figures)}" for name, figures in kinds.items() if figures]


def changes(figures: Mapping[str, PairedFigure]) -> Changes:
    """The changes in those `MEASURES` that apply. A single pair cannot show that there is no difference."""
    by_tone: dict[str, list[str]] = {GOOD: [], BAD: [], "": []}
    for name, words in MEASURES.items():
        if name in figures and (figure := figures[name]).n:
            how = tone(figure)
            value = wording.interval(figure.difference, figure.measure, signed=True, n=figure.n)
            if how or figure.n >= wording.SEVERAL:
                by_tone[how].append(f"{words} {value}" if how else words)
    return Changes(by_tone[GOOD], by_tone[BAD], by_tone[""])


def tone(figure: PairedFigure) -> str:
    """Whether a difference is good or bad; "" if it can be due to chance.

    It can with fewer than FEWEST pairs, if the interval contains 0, or if McNemar's exact p of a rate is 5 %
    or more: with few crashes Tango's interval may exclude 0 although the exact test is not significant.
    """
    d = figure.difference
    chance = figure.n < FEWEST or math.isnan(d.low) or d.low <= 0.0 <= d.high
    if chance or (figure.p is not None and figure.p >= 1.0 - CONFIDENCE) or not figure.measure.better:
        return ""
    return GOOD if (d.value > 0.0) == (figure.measure.better == "higher") else BAD
