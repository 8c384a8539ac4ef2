"""What is still to be driven, page by page, and its cost: reckoned from short episodes driven just now."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from benchmarks.papers.agents import missing
from benchmarks.papers.driving import AgentRunner, Order, Planned, Settings, agent_of, held, planned
from cosim.batch import estimate
from cosim.batch.matrix import Cell
from cosim.workers.engines import LocalEngine

PROBES = 2  # worlds in which an agent's cost is measured


@dataclass(frozen=True, slots=True)
class Left:
    """Episodes that one agent has still to drive for a page."""

    agent: str
    episodes: int
    hours: float | None  # of one CPU; None: no short episode came through


class Reckoning:
    """Asked page after page: an agent is measured once, an episode that pages share counts with the first."""

    def __init__(self) -> None:
        self._counted: set[tuple[str, int]] = set()  # cell and seed
        self._costs: dict[str, list[estimate.Cost]] = {}  # by agent

    def left(self, title: str, orders: Sequence[Order], settings: Settings) -> list[Left]:
        """What the page still needs, agent by agent.

        Agents without weights are counted with untrained networks, which cost the same.

        Raises BadInput when a world or demand is wrong.
        """
        lacking = {o.agent for o in orders if not settings.untrained and missing(o.agent)}
        found = []
        for untrained in (False, True):
            group = [o for o in settings.chosen(orders) if (o.agent in lacking) == untrained]
            drive = replace(settings, untrained=settings.untrained or untrained)
            work = planned(group, drive)
            todo = self._todo(work, drive)
            self._measure(title, work, todo)
            names = dict.fromkeys(agent_of(cell.case.policy) for cell in work.cells)
            found += [self._of(name, work, todo) for name in names]
        return [one for one in found if one.episodes]

    def _todo(self, work: Planned, settings: Settings) -> dict[str, int]:
        """Cell -> episodes that are neither there nor counted before; they count as that from now on."""
        there = held(work, settings)
        todo = {}
        for cell, seeds in work.wanted.items():
            fresh = {(cell, s) for s in seeds if s not in there.get(cell, ())} - self._counted
            self._counted |= fresh
            todo[cell] = len(fresh)
        return todo

    def _measure(self, title: str, work: Planned, todo: Mapping[str, int]) -> None:
        """What the agents cost that have something to drive and were not measured yet."""
        probes: dict[str, dict[str, Cell]] = {}  # agent -> world -> cell
        for cell in work.cells:
            if todo[cell.name] and agent_of(cell.case.policy) not in self._costs:
                probes.setdefault(agent_of(cell.case.policy), {}).setdefault(cell.case.what, cell)
        if not probes:
            return
        print(f"{title}: measuring what {len(probes)} agents cost ...", file=sys.stderr, flush=True)
        chosen = [cell for mine in probes.values() for cell in [*mine.values()][:PROBES]]
        engine = LocalEngine(AgentRunner, (work.agents, work.untrained), workers=1)
        self._costs |= {agent: [] for agent in probes}
        for (_, policy), cost in estimate.probe(chosen, engine).items():
            self._costs[agent_of(policy)].append(cost)

    def _of(self, agent: str, work: Planned, todo: Mapping[str, int]) -> Left:
        mine = [cell for cell in work.cells if agent_of(cell.case.policy) == agent]
        episodes, costs = sum(todo[cell.name] for cell in mine), self._costs.get(agent, ())
        if not costs:
            return Left(agent, episodes, None)
        reset, second = fmean(c.reset for c in costs), fmean(c.second for c in costs)
        spent = sum(todo[cell.name] * (reset + second * cell.scenario.duration) for cell in mine)
        return Left(agent, episodes, spent / 3600.0)
