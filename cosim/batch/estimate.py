"""How long a matrix will take: a few short episodes of it are driven, and the rest is computed from them."""

import itertools
from collections.abc import Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, replace
from statistics import fmean

from cosim.batch.matrix import Cell, Plan
from cosim.workers.engines import Engine

PROBES = 8  # cells at most: a dry run should stay a matter of seconds
PROBE = 4.0  # counted s per probe: ten decisions


@dataclass(frozen=True, slots=True)
class Cost:
    """What one cell costs, in s of wall time."""

    start: float  # once per worker: net, policy, compiled code
    reset: float  # once per episode, warm-up included
    second: float  # per counted second


def estimate(plan: Plan, engine: Engine, workers: int) -> tuple[float | None, str]:
    """Wall time of a whole matrix in s (None: no probe came through), and what it rests on.

    The first seed of some cells is driven for `PROBE` s each, and the rest is computed from them.
    A cell that was not probed is taken to cost what those of the same policy do. Traffic that grows during an
    episode makes the estimate too low, an early end by a crash makes it too high.
    """
    costs = probe(_chosen(plan.cells), engine)
    if not costs:
        return None, "no short episode came through: see the rows' errors in a real run"
    driven = [(cell.scenario.duration, _like(cell, costs)) for cell in plan.cells if cell.refused is None]
    total = sum(cost.start + len(plan.seeds) * (cost.reset + cost.second * s) for s, cost in driven)
    basis = f"{len(costs)} of {len(plan.cells)} cells driven for {PROBE:g} s just now, {workers} workers"
    return total / workers, basis


def probe(cells: Sequence[Cell], engine: Engine) -> dict[tuple[str, str], Cost]:
    """(world or file, policy) -> cost, of those cells whose short episode came through."""
    tasks = {}
    for cell in cells:
        case = replace(cell.case, duration=min(PROBE, cell.scenario.duration), outputs=())
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
    """One cell of each world and policy, those of different policies first."""
    found: dict[str, dict[str, Cell]] = {}
    for cell in cells:
        if cell.refused is None:
            found.setdefault(cell.case.policy, {}).setdefault(cell.case.what, cell)
    rounds = itertools.zip_longest(*(worlds.values() for worlds in found.values()))
    return [cell for mixed in rounds for cell in mixed if cell is not None][:PROBES]


def _like(cell: Cell, costs: dict[tuple[str, str], Cost]) -> Cost:
    """The cost of the same world and policy, else the mean of the policy, else of all."""
    if known := costs.get((cell.case.what, cell.case.policy)):
        return known
    alike = [cost for (_, policy), cost in costs.items() if policy == cell.case.policy] or [*costs.values()]
    return Cost(*map(fmean, zip(*map(astuple, alike), strict=True)))
