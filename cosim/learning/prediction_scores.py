"""Scores of vehicle forecasts: position error and interval coverage, episode by episode."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from cosim.report import statistics
from cosim.types import Floats

LEVEL = 0.9  # nominal coverage of an interval
LEVEL_DEVIATIONS = 1.645  # half width in standard deviations
REPORTED = (0.2, 0.4, 1.0, 2.0, 3.0, 4.0)  # s (observation.md, Clocks)
QUANTITIES = ("speed", "heading", "along", "across")  # the last two: position, in driving direction and aside


class Predicted(NamedTuple):
    """Forecasts of S moments of single vehicles, M frames ahead; spread 0 for predictors without one."""

    x: Floats  # [S,M] m
    y: Floats  # [S,M] m
    speed: Floats  # [S,M] m/s
    heading: Floats  # [S,M] rad
    std: tuple[Floats, Floats, Floats, Floats]  # each [S,M], see QUANTITIES


def position_error(predicted: Predicted, future: Floats) -> Floats:
    """Distance between forecast and truth [S,M] in m; future [S,M,4] x y speed heading, nan after the vehicle
    left. P's PE before averaging."""
    return np.asarray(np.hypot(predicted.x - future[:, :, 0], predicted.y - future[:, :, 1]))


def interval_errors(predicted: Predicted, future: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Errors [S,M] to be covered by the intervals of QUANTITIES, nan without truth."""
    dx, dy = future[:, :, 0] - predicted.x, future[:, :, 1] - predicted.y
    c, s = np.cos(predicted.heading), np.sin(predicted.heading)
    turn = (future[:, :, 3] - predicted.heading + np.pi) % (2 * np.pi) - np.pi
    return future[:, :, 2] - predicted.speed, turn, c * dx + s * dy, c * dy - s * dx


@dataclass
class Scores:
    """Per predictor and episode: the mean error, the share covered, the interval's width, at every step."""

    steps: int  # M
    dt: float  # s
    cases: list[Mapping[str, Any]] = field(default_factory=list)  # one an episode: scenario, behavior, ...
    counts: list[Floats] = field(default_factory=list)  # [M] forecasts with a truth, per episode
    errors: dict[str, list[Floats]] = field(default_factory=dict)  # predictor -> per episode [M] m
    covered: dict[str, list[Floats]] = field(default_factory=dict)  # -> per episode [4,M]
    widths: dict[str, list[Floats]] = field(default_factory=dict)  # -> per episode [4,M]

    def add(self, case: Mapping[str, Any], future: Floats, forecasts: Mapping[str, Predicted]) -> None:
        """Add one episode: truth, and each predictor's forecast."""
        self.cases.append(case)
        self.counts.append(np.isfinite(future[:, :, 0]).sum(0).astype(np.float64))
        for name, predicted in forecasts.items():
            self.errors.setdefault(name, []).append(_mean(position_error(predicted, future)))
            if not any(std.any() for std in predicted.std):
                continue
            missed = interval_errors(predicted, future)
            inside = np.full((len(QUANTITIES), self.steps), np.nan)
            width = np.full_like(inside, np.nan)
            for q, (error, std) in enumerate(zip(missed, predicted.std, strict=True)):
                if std.any():
                    hit = np.where(np.isfinite(error), np.abs(error) <= LEVEL_DEVIATIONS * std, np.nan)
                    inside[q], width[q] = _mean(hit), 2.0 * LEVEL_DEVIATIONS * std.mean(0)
            self.covered.setdefault(name, []).append(inside)
            self.widths.setdefault(name, []).append(width)

    def horizons(self) -> dict[float, int]:
        """Reported horizon in s -> index of its step."""
        steps = {h: round(h / self.dt) - 1 for h in REPORTED}
        return {h: k for h, k in steps.items() if k < self.steps}

    def groups(self) -> list[tuple[str, str, list[int]]]:
        """(scenario, behavior, episodes): every pair; every scenario over all behaviours; and all of it."""
        keys = [(str(c["scenario"]), str(c["behavior"])) for c in self.cases]
        found = [(s, b, [i for i, k in enumerate(keys) if k == (s, b)]) for s, b in sorted(set(keys))]
        found += [
            (s, "all", [i for i, k in enumerate(keys) if k[0] == s]) for s in sorted({k[0] for k in keys})
        ]
        return [*found, ("all", "all", list(range(len(keys))))]

    def position_table(self) -> list[dict[str, Any]]:
        """Rows of position_error.csv. `horizon_s` is a time, or "mean": over the whole horizon.

        The mean is over episodes, of each episode's mean over vehicles and moments; its interval is
        bootstrapped over episodes, because vehicles of one episode are not independent. "all" scenarios:
        equal weight of all scenarios. `n`: forecasts.
        """
        rows = []
        spans: dict[float | str, slice] = {h: slice(k, k + 1) for h, k in self.horizons().items()}
        spans["mean"] = slice(None)
        for predictor, errors in self.errors.items():
            each = np.stack(errors)  # [E,M]
            for scenario, behavior, members in self.groups():
                counts = np.stack([self.counts[i] for i in members])
                for horizon, span in spans.items():
                    values = each[members][:, span].mean(1)
                    figure = statistics.mean(self._balanced(values, members, scenario))
                    rows.append(
                        {
                            "predictor": predictor,
                            "scenario": scenario,
                            "behavior": behavior,
                            "horizon_s": horizon,
                            "mean_m": figure.value,
                            "ci_low": figure.low,
                            "ci_high": figure.high,
                            "n": int(counts[:, span].sum()),
                        }
                    )
        return rows

    def coverage_table(self) -> list[dict[str, Any]]:
        """Rows of interval_coverage.csv; `coverage` of nominal LEVEL, `width` in m/s, rad or m."""
        rows = []
        for predictor, shares in self.covered.items():
            each, wide = np.stack(shares), np.stack(self.widths[predictor])  # [E,4,M]
            for scenario, behavior, members in self.groups():
                for q, quantity in enumerate(QUANTITIES):
                    if np.isnan(each[:, q]).all():
                        continue
                    for horizon, k in self.horizons().items():
                        figure = statistics.mean(self._balanced(each[members][:, q, k], members, scenario))
                        rows.append(
                            {
                                "predictor": predictor,
                                "quantity": quantity,
                                "scenario": scenario,
                                "behavior": behavior,
                                "horizon_s": horizon,
                                "level": LEVEL,
                                "coverage": figure.value,
                                "ci_low": figure.low,
                                "ci_high": figure.high,
                                "width": float(wide[members][:, q, k].mean()),
                                "n": int(sum(self.counts[i][k] for i in members)),
                            }
                        )
        return rows

    def _balanced(self, values: Floats, members: list[int], scenario: str) -> Floats:
        """Values weighted so that each scenario has equal weight in "all", for any number of episodes."""
        if scenario != "all":
            return values
        names = [str(self.cases[i]["scenario"]) for i in members]
        count = {name: names.count(name) for name in names}
        return np.asarray(values * [len(names) / (len(count) * count[name]) for name in names])


def _mean(values: Floats) -> Floats:
    """Mean over the first axis without nan; nan if all are nan."""
    there = np.isfinite(values)
    total = np.where(there, values, 0.0).sum(0)
    return np.asarray(np.where(there.any(0), total / np.maximum(there.sum(0), 1), np.nan))
