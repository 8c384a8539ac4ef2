"""The agent without preferences that shows what the prioritizer alone does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from policy_scenes import Car, histories, straight_road

from cosim.policies import make
from cosim.types import Decision, MetaAction, PolicyContext, Timing
from policy.agents.approaches import compact
from research.policies import MaskOnly, cruise, masked_random

ROAD = straight_road(2)
PLAIN = compact("vfn-p")


def decide(agent: MaskOnly, *cars: Car, share_intentions: bool = True) -> dict[str, Decision]:
    context = PolicyContext(ROAD, Timing(), agent.observation, 0.0, np.random.default_rng(0))
    agent.reset(replace(context, share_intentions=share_intentions))
    return agent.decide(histories(ROAD, cars, agent.observation))


def test_with_a_free_road_it_keeps_lane_and_speed() -> None:
    decision = decide(cruise(), Car("a", 300.0, 0, 20.0, is_av=True))["a"]
    assert decision.action == MetaAction.IDLE
    assert not decision.vetoed


def test_behind_a_slow_car_the_mask_makes_it_brake_and_without_one_it_drives_on() -> None:
    cars = Car("a", 300.0, 0, 25.0, is_av=True), Car("slow", 335.0, 0, 5.0), Car("beside", 298.0, 1, 25.0)
    guarded = decide(cruise(), *cars)["a"]
    assert (guarded.action, guarded.blamed) == (MetaAction.DECELERATE, "slow")
    bare = decide(MaskOnly("cruise", replace(PLAIN, mask=False)), *cars)["a"]
    assert bare.action == MetaAction.IDLE


def test_after_giving_way_it_picks_up_speed_again() -> None:
    decision = decide(cruise(), Car("a", 300.0, 0, 4.0, is_av=True, target=5.0))["a"]
    assert decision.action == MetaAction.ACCELERATE


def test_without_intentions_a_follower_may_not_drive_as_close() -> None:
    """5 m behind an AV at 20 m/s: enough for an AV that gets braking by V2V, not for one that sees it."""
    cars = Car("lead", 300.0, 0, 20.0, is_av=True), Car("follow", 290.0, 0, 20.0, is_av=True)
    shared, seen = (decide(cruise(), *cars, share_intentions=share)["follow"] for share in (True, False))
    assert (shared.action, shared.vetoed) == (MetaAction.IDLE, False)
    assert (seen.vetoed, seen.blamed) == (True, "lead")


def test_a_claim_names_it_and_its_rows_warn_of_nothing() -> None:
    made = make("cruise=research.policies:cruise")
    assert (made.name, made.label) == ("cruise", "")


def test_random_decisions_are_drawn_anew_and_stay_behind_the_mask() -> None:
    free = [Car("a", 300.0, 0, 20.0, is_av=True), Car("b", 500.0, 0, 20.0, is_av=True)]
    agent = masked_random()
    agent.reset(PolicyContext(ROAD, Timing(), agent.observation, 0.0, np.random.default_rng(0)))
    scene = histories(ROAD, free, agent.observation)
    chosen = [agent.decide(scene)[name].action for _ in range(40) for name in ("a", "b")]
    assert len(set(chosen)) > 3
    blocked = [
        Car("a", 300.0, 0, 25.0, is_av=True),
        Car("slow", 335.0, 0, 5.0),
        Car("beside", 298.0, 1, 25.0),
    ]
    scene = histories(ROAD, blocked, agent.observation)
    assert {agent.decide(scene)["a"].action for _ in range(40)} == {MetaAction.DECELERATE}
