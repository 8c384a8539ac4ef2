"""The agent without preferences that shows what the prioritizer alone does, and with which settings."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from policy_scenes import Car, histories, straight_road

from benchmarks import agent as agent_costs
from benchmarks import prioritizer
from benchmarks.papers.agents import build, config, fingerprint
from benchmarks.papers.claims import VFN_P
from benchmarks.unled import Unled
from cosim.types import Decision, MetaAction, PolicyContext, Timing
from policy.agents.approaches import compact
from policy.safety import SafetyConfig

ROAD = straight_road(2)
PLAIN = compact("vfn-p")


def decide(agent: Unled, *cars: Car) -> dict[str, Decision]:
    agent.reset(PolicyContext(ROAD, Timing(), agent.observation, 0.0, np.random.default_rng(0)))
    return agent.decide(histories(ROAD, cars, agent.observation))


def test_with_a_free_road_it_keeps_lane_and_speed() -> None:
    decision = decide(Unled("cruise", PLAIN), Car("a", 300.0, 0, 20.0, is_av=True))["a"]
    assert decision.action == MetaAction.IDLE
    assert not decision.vetoed


def test_behind_a_slow_car_the_mask_makes_it_brake_and_without_one_it_drives_on() -> None:
    cars = Car("a", 300.0, 0, 25.0, is_av=True), Car("slow", 335.0, 0, 5.0), Car("beside", 298.0, 1, 25.0)
    guarded = decide(Unled("cruise", PLAIN), *cars)["a"]
    assert (guarded.action, guarded.blamed) == (MetaAction.DECELERATE, "slow")
    bare = decide(Unled("cruise", replace(PLAIN, mask=False)), *cars)["a"]
    assert bare.action == MetaAction.IDLE


def test_after_giving_way_it_picks_up_speed_again() -> None:
    decision = decide(Unled("cruise", PLAIN), Car("a", 300.0, 0, 4.0, is_av=True, target=5.0))["a"]
    assert decision.action == MetaAction.ACCELERATE


def test_without_intentions_a_follower_may_not_drive_as_close() -> None:
    """5 m behind an AV at 20 m/s: enough for an AV that gets braking by V2V, not for one that sees it."""
    cars = Car("lead", 300.0, 0, 20.0, is_av=True), Car("follow", 290.0, 0, 20.0, is_av=True)
    shared, seen = (decide(Unled("cruise", PLAIN, share), *cars)["follow"] for share in (True, False))
    assert (shared.action, shared.vetoed) == (MetaAction.IDLE, False)
    assert (seen.vetoed, seen.blamed) == (True, "lead")


def test_random_preferences_are_guarded_and_come_from_the_episodes_generator() -> None:
    cars = Car("a", 300.0, 0, 25.0, is_av=True), Car("slow", 335.0, 0, 5.0), Car("beside", 298.0, 1, 25.0)
    first, second = (decide(Unled("random", PLAIN, random=True), *cars)["a"] for _ in range(2))
    assert first.q is not None
    assert second.q is not None
    assert np.array_equal(first.q, second.q)
    assert len(set(first.q)) == 5
    assert first.action == MetaAction.DECELERATE, "nothing else is safe"


def test_every_setting_is_another_agent_and_the_default_is_the_shipped_one() -> None:
    cruise = prioritizer.AGENTS["cruise"]
    prints = [str(fingerprint(s.applied(cruise))) for s in prioritizer.SETTINGS]
    assert len(set(prints)) == len(prints)
    assert config(prioritizer.SETTINGS[0].applied(cruise)).safety == SafetyConfig()
    assert prioritizer.SETTINGS[0].applied(prioritizer.AGENTS[VFN_P]) == prioritizer.AGENTS[VFN_P]
    strict = next(s for s in prioritizer.SETTINGS if s.name == "safe_th 4 s").applied(cruise)
    made = build(strict)
    assert isinstance(made, Unled)
    assert made.config.safety.safe_th == 4.0
    assert made.label == ""


def test_the_score_threshold_binds_only_beyond_the_bound_that_the_page_names() -> None:
    """A slow car at every distance: what is refused is the same up to that bound, and more above it."""

    def refused(safe_th: float) -> list[list[bool]]:
        held = replace(SafetyConfig(), safe_th=safe_th, brake_after=60.0)  # nobody is merely followed
        agent = Unled("cruise", replace(PLAIN, safety=held))
        found = []
        for ahead in range(10, 125, 15):
            cars = Car("a", 300.0, 0, 20.0, is_av=True), Car("slow", 300.0 + ahead, 0, 5.0)
            unsafe = decide(agent, *cars)["a"].unsafe
            assert unsafe is not None
            found.append(unsafe.tolist())
        return found

    (bound,) = re.findall(r"exceeds (\d\.\d) s", " ".join(prioritizer._bites(SafetyConfig())))
    assert float(bound) == 4.0
    default = refused(3.0)
    assert refused(1.0) == refused(4.0) == default
    assert sum(map(sum, refused(6.0))) > sum(map(sum, default))


def test_it_is_compared_on_tuning_seeds_alone() -> None:
    last = prioritizer.JOB.first + max(order.episodes for order in prioritizer.orders())
    assert 100_000 <= prioritizer.JOB.first < last <= 200_000


def test_the_parts_of_a_decision_add_up() -> None:
    seen = histories(
        ROAD, [Car("a", 300.0, 0, 20.0, is_av=True), Car("b", 250.0, 1, 20.0, is_av=True)], PLAIN.observation
    )
    context = PolicyContext(ROAD, Timing(), PLAIN.observation, 0.0, np.random.default_rng(0))
    spent = agent_costs.decision(
        replace(PLAIN, predicted_maps=False, vfn=compact("vfn").vfn, vfn_weights=None), ROAD, [seen], context
    )
    assert list(spent) == ["prediction", "values", "prioritizer", "decision", "processor time"]
    assert min(spent.values()) > 0.0
    assert spent["decision"] == pytest.approx(sum([*spent.values()][:3]))


def test_the_page_of_costs_says_what_is_missed() -> None:
    parts = {
        "prediction": 20.0,
        "values": 15.0,
        "prioritizer": 10.0,
        "decision": 45.0,
        "processor time": 44.0,
    }
    rates = {"joint decisions/s": 30.0, "updates/s": 2.0}
    found = {
        "decisions": {"compact": {2: parts, 1: parts | {"decision": 60.0}}, "paper": {2: parts}},
        "closed loop": {"simulation": 3.0, "decision": 40.0},
        "training": {"compact": rates},
    }
    lines = agent_costs.page(found, "a command")
    assert "| compact | 2 | 20.0 | 15.0 | 10.0 | 45.0 | 44.0 | met (at most 50) |" in lines
    assert "| compact | 1 | 20.0 | 15.0 | 10.0 | 60.0 | 44.0 | **missed** (at most 50) |" in lines
    assert "| paper | 2 | 20.0 | 15.0 | 10.0 | 45.0 | 44.0 | measured |" in lines
    assert any("joint decisions/s: **missed** (at least 60)" in line for line in lines)
