"""What every `cosim.types.Policy` must keep: inherit `PolicyContract` and give it a `policy` fixture.

The world is the shipped fake simulator, so that a new policy is tested without SUMO in a few seconds.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping

import numpy as np

from cosim.control import to_commands
from cosim.observation.observer import Observer
from cosim.seeding import generator
from cosim.simulation.fake import FakeSimulator, FakeVehicle
from cosim.types import (
    Decision,
    History,
    LooksAhead,
    MetaAction,
    ObservationConfig,
    Policy,
    PolicyContext,
    Timing,
)

TIMING = Timing()


def traffic() -> FakeSimulator:
    """Three AVs among humans on two lanes; one AV soon leaves the road, the mission vehicle is slow."""
    return FakeSimulator(
        [
            FakeVehicle("a", 500.0, 0, 20.0, is_av=True),
            FakeVehicle("b", 250.0, 0, 20.0, is_av=True),
            FakeVehicle("c", 200.0, 1, 20.0, is_av=True),
            FakeVehicle("human", 230.0, 1, 18.0),
            FakeVehicle("mission", 290.0, 0, 15.0, mission=True, desired=15.0),
        ],
        length=520.0,
    )


def episode(policy: Policy, seed: int, decisions: int = 8) -> list[dict[str, Decision]]:
    """What the policy decides in `traffic`."""
    world = traffic()
    observer = Observer(world.road, policy.observation)
    shown(policy, world)
    policy.reset(context(world, policy.observation, seed))
    frames = world.reset(0)
    chosen = []
    for _ in range(decisions):
        for frame in frames:
            observer.add(frame)
        histories = observer.histories(world.route, world.commanded)
        chosen.append(policy.decide(histories))
        check(chosen[-1], histories)
        _, frames = world.advance(to_commands(chosen[-1], histories, TIMING.decision))
    return chosen


def shown(policy: Policy, world: FakeSimulator) -> None:
    """A policy that looks ahead may: as a host does it."""
    if isinstance(policy, LooksAhead):
        policy.looks_ahead(world.ahead)


def context(world: FakeSimulator, observation: ObservationConfig, seed: int) -> PolicyContext:
    return PolicyContext(world.road, TIMING, observation, math.radians(45.0), generator(seed, "policy"))


def check(decisions: Mapping[str, Decision], histories: Mapping[str, History]) -> None:
    """Only AVs on the road are decided for; what explains a decision has the shape of the five actions."""
    assert set(decisions) <= set(histories)
    for decision in decisions.values():
        assert decision.action in MetaAction
        for explained in (decision.q, decision.safety_score, decision.unsafe, decision.ttc):
            assert explained is None or np.shape(explained) == (len(MetaAction),)
        for numbers in (decision.q, decision.safety_score, decision.ttc):
            assert numbers is None or not np.isnan(numbers).any()
        if decision.unsafe is not None and decision.unsafe[decision.action]:
            assert decision.fallback  # an unsafe action is only ever the last resort


class PolicyContract:
    """Tests to inherit."""

    def test_it_says_what_it_is(self, policy: Policy) -> None:
        assert policy.name
        assert isinstance(policy.label, str)
        assert isinstance(policy.observation, ObservationConfig)
        assert all(isinstance(k, str) and isinstance(v, str) for k, v in policy.av_parameters.items())

    def test_it_drives_avs_that_come_and_go(self, policy: Policy) -> None:
        chosen = episode(policy, seed=1)  # `check`: it commands nobody who is not there
        assert "a" not in chosen[-1]

    def test_the_same_seed_twice_decides_the_same(self, policy: Policy) -> None:
        def actions(seed: int) -> list[dict[str, MetaAction]]:
            return [{name: d.action for name, d in step.items()} for step in episode(policy, seed)]

        first = actions(5)
        actions(6)
        assert actions(5) == first

    def test_nobody_on_the_road_is_nothing_to_decide(self, policy: Policy) -> None:
        policy.reset(context(traffic(), policy.observation, 0))
        assert policy.decide({}) == {}

    def test_what_it_is_shown_stays_as_it_was(self, policy: Policy) -> None:
        world = traffic()
        observer = Observer(world.road, policy.observation)
        shown(policy, world)
        policy.reset(context(world, policy.observation, 0))
        for frame in world.reset(0):
            observer.add(frame)
        histories = observer.histories(world.route, world.commanded)
        fields = ("velocity_map", "kinematics", "valid", "lane", "lane_position", "pose")
        before = {n: {f: copy.deepcopy(getattr(h, f)) for f in fields} for n, h in histories.items()}
        policy.decide(histories)
        for name, kept in before.items():
            for field, value in kept.items():
                np.testing.assert_array_equal(getattr(histories[name], field), value)
