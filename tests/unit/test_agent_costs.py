"""What the agent costs, in parts and on its page."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from policy_scenes import Car, histories, straight_road

from benchmarks import agent as agent_costs
from cosim.types import PolicyContext, Timing
from policy.agents.approaches import compact

ROAD = straight_road(2)
PLAIN = compact("vfn-p")


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
