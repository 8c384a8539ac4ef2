"""Estimated wall time of a matrix, extrapolated from a few short episodes."""

import itertools
from collections.abc import Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, replace
from statistics import fmean

from cosim.batch.matrix import Cell, Plan
from cosim.workers.engines import Engine

MAX_PROBES = 8  # cells; limits a dry run to seconds
PROBE_TIME = 4.0  # counted s per probe: ten decisions


@dataclass(frozen=True, slots=True)
class Cost:
    """The cost of one cell, in s of wall time."""

    start: float  # once per worker: net, policy, compiled code
    reset: float  # once per episode, warm-up included
    second: float  # per counted second


def estimate(plan: Plan, engine: Engine, workers: int) -> tuple[float | None, str]:
    """Wall time of a whole matrix in s (None: every probe failed), and the basis of the estimate.

    The first seed of some cells is driven for `PROBE_TIME` s each and extrapolated. A cell without a probe
    gets the mean cost of its policy. The estimate is too low for traffic that grows during an episode, and
    too high for episodes that end early by a crash.
    """
    costs = probe(_chosen(plan.cells), engine)
    if not costs:
        return None, "every short episode failed: the rows of a real run have the errors"
    driven = [(cell.scenario.duration, _cost_of(cell, costs)) for cell in plan.cells if cell.refused is None]
    total = sum(cost.start + len(plan.seeds) * (cost.reset + cost.second * s) for s, cost in driven)
    basis = f"{len(costs)} of {len(plan.cells)} cells driven for {PROBE_TIME:g} s just now, {workers} workers"
    return total / workers, basis


def probe(cells: Sequence[Cell], engine: Engine) -> dict[tuple[str, str], Cost]:
    """(scenario, policy) -> cost, for cells with a completed probe."""
    tasks = {}
    for cell in cells:
        case = replace(cell.case, duration=min(PROBE_TIME, cell.scenario.duration), outputs=())
        tasks[case.key] = cell, replace(cell, case=case).task(case)
    costs = {}
    with closing(engine.run([task for _, task in tasks.values()])) as outcomes:
        for outcome in outcomes:
            if outcome.ok and outcome.value["steps"]:
                cell, _ = tasks[outcome.key]
                times = outcome.value["timings"]
                drive = times["total_s"] - times["compilation_s"]
                driven = outcome.value["steps"] * cell.scenario.timing.decision
                costs[cell.case.what, cell.case.policy] = Cost(
                    start=max(outcome.seconds - drive, 0.0),
                    reset=times["reset_s"],
                    second=(drive - times["reset_s"]) / driven,
                )
    return costs


def _chosen(cells: Sequence[Cell]) -> list[Cell]:
    """At most `MAX_PROBES` cells: one of each scenario and policy, different policies first."""
    found: dict[str, dict[str, Cell]] = {}
    for cell in cells:
        if cell.refused is None:
            found.setdefault(cell.case.policy, {}).setdefault(cell.case.what, cell)
    rounds = itertools.zip_longest(*(worlds.values() for worlds in found.values()))
    return [cell for mixed in rounds for cell in mixed if cell is not None][:MAX_PROBES]


def _cost_of(cell: Cell, costs: dict[tuple[str, str], Cost]) -> Cost:
    """The cost of the same scenario and policy, else the mean of the policy, else of all."""
    if known := costs.get((cell.case.what, cell.case.policy)):
        return known
    same = [cost for (_, policy), cost in costs.items() if policy == cell.case.policy] or [*costs.values()]
    return Cost(*map(fmean, zip(*map(astuple, same), strict=True)))
