"""What another action would have changed, driven in copies of the simulation.

A decision of 0.4 s changes little, and what everybody else does meanwhile changes much: the difference
between two actions drowns in the returns of a replay buffer. In a copy of the simulation where one AV alone
does otherwise, everybody else driving by the same policy and the same draws, nearly all of that cancels (the
vine procedure with common random numbers: Schulman et al. 2015, Trust Region Policy Optimization, 5.2).
Where nobody gets in unless two slow down, one alone shows nothing: `ForkConfig.together` lets several.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cosim.episode import Episode, Hook, Step, go_on
from cosim.seeding import generator
from cosim.simulation.fork import forked
from cosim.types import Decision, Floats, Floats32, MetaAction
from policy.inputs.meeting import meet, missions
from policy.training.curriculum import Drive
from policy.training.experience import Trajectory
from policy.training.explorer import Explorer

SIDEWAYS = (MetaAction.LANE_LEFT, MetaAction.LANE_RIGHT)
NEAREST = 4  # AVs whose way meets the mission vehicle's: who arrives next before or behind it lets it in
RARELY = 0.2  # a lane change is tried so often where an action that keeps the lane is tried once

Tried = tuple[str, int, MetaAction, Floats32]  # AV, its decision, action, [H,3] reward terms from there on


class Forks(Hook):
    """At drawn decisions of a drive learning AVs do otherwise for some decisions, in a copy.

    Goes behind the hook that pays the agent. `compared` adds to the drive's trajectories what was found.
    """

    def __init__(self, agent: Explorer, drive: Drive) -> None:
        self._agent, self._drive = agent, drive

    def on_start(self, episode: Episode) -> None:
        """Draw when."""
        self._rng = generator(episode.seed, "forks")
        timing = episode.scenario.timing
        planned = round(episode.scenario.duration / timing.decision)
        count = min(self._drive.forks.count, planned - 1)
        self._at = set((1 + self._rng.permutation(planned - 1)[:count]).tolist())
        self._tried: list[Tried] = []

    def on_step(self, episode: Episode, step: Step) -> None:
        """A copy, if it is time."""
        if episode.steps not in self._at or episode.over:
            return
        known = sorted(self._agent.learning.keys() & episode.histories.keys())
        if known:
            rng, together = self._rng, self._drive.forks.together
            if self._drive.forks.meeting and rng.random() < self._drive.forks.meeting:
                known = _nearest(episode, known) or known
            avs, seed = [known.pop(rng.integers(len(known)))], int(rng.integers(2**32))
            if together > 1:
                avs += rng.permutation(known)[: rng.integers(together)].tolist()
            self._tried += forked(lambda: self._otherwise(episode, avs, np.random.default_rng(seed)))

    def compared(self, trajectories: Sequence[Trajectory]) -> list[Trajectory]:
        """The trajectories, with the actions tried and what they brought more."""
        forks, gamma = self._drive.forks, self._drive.gamma
        by_av = {one.av: one for one in trajectories}
        for av, t, action, terms in self._tried:
            one = by_av.get(av)
            if one is None or t >= len(one) or action == one.action[t]:
                continue
            if one.tried is None or one.gain is None:
                nothing = np.full(len(one), -1, np.int8), np.zeros((len(one), 2), np.float32)
                one = by_av[av] = replace(one, tried=nothing[0], gain=nothing[1])
            assert one.tried is not None
            assert one.gain is not None
            one.tried[t] = action
            one.gain[t] = _worth(terms, gamma) - _worth(one.terms[t : t + forks.horizon], gamma)
        return [by_av[one.av] for one in trajectories]

    def _otherwise(self, episode: Episode, avs: Sequence[str], rng: np.random.Generator) -> list[Tried]:
        """In the copy: drive on with another action of the first of `avs` that has one that is safe, the same
        for the others of them where it is another and safe; nothing where nobody has one."""
        agent, forks = self._agent, self._drive.forks
        self._at = set()
        decisions = agent.decide(episode.histories)
        chances = {av: _chances(decisions[av]) for av in avs}
        first = next((c for c in chances.values() if c.any()), None)
        if first is None:
            return []
        action = MetaAction(rng.choice(len(first), p=first / first.sum()))
        tried = {av: agent.recorded(av) for av, c in chances.items() if c[action]}
        for av in tried:
            agent.hold(av, action, forks.held - 1)
        changed = {**decisions, **{av: decisions[av]._replace(action=action) for av in tried}}
        go_on(episode, agent, changed, forks.horizon)
        mine = {one.av: one for one in agent.finish()}
        return [(av, t, action, mine[av].terms[t : t + forks.horizon]) for av, t in tried.items()]


def _nearest(episode: Episode, avs: Sequence[str]) -> list[str]:
    """Up to `NEAREST` of `avs`, by name, that come nearest a mission vehicle where their ways meet."""
    histories, road = episode.histories, episode.simulator.road
    seen = missions(histories.values()).values()
    behind = {av: [m.behind for at in seen if (m := meet(road, histories[av], at))] for av in avs}
    distance = {av: min(map(abs, each)) for av, each in behind.items() if each}
    return sorted(sorted(distance, key=distance.__getitem__)[:NEAREST])


def _chances(decision: Decision) -> Floats:
    """[A] how often each action is tried where `decision` was taken: only others, and safe ones."""
    chances = np.array([RARELY if a in SIDEWAYS else 1.0 for a in MetaAction])
    chances[decision.action] = 0.0
    if decision.unsafe is not None:
        chances[decision.unsafe] = 0.0
    return chances


def _worth(terms: Floats32, gamma: float) -> Floats32:
    """[2] the discounted sums of reward terms [H,3]: one's own, and the others'."""
    fading = gamma ** np.arange(len(terms))
    return np.array((fading @ terms[:, 0], fading @ terms[:, 1:].sum(1)), np.float32)
